"""LCDNet: loop detection and 6-DoF registration by one network (thesis chapter 3).

Cattaneo, Vaghi and Valada, "LCDNet: Deep Loop Closure Detection and Point Cloud Registration for
LiDAR SLAM", T-RO 2022. Only torch, numpy and scipy are needed here.
"""

from lcd_loop_closure.lcdnet.config import COMPACT, FULL, LcdnetConfig
from lcd_loop_closure.lcdnet.network import Features, Lcdnet

__all__ = ['COMPACT', 'FULL', 'Features', 'Lcdnet', 'LcdnetConfig']
