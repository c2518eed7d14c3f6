"""Report what a pose graph node holds, and what waits in it."""

from lcd_common.nodes.diagnostics import Diagnostics
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.nodes.extra_sensors import ExtraSensors
from lcd_loop_closure.nodes.graph_judge import GraphJudge
from lcd_loop_closure.online_map import OnlineMap


def watch_graph(
    diagnostics: Diagnostics, online_map: OnlineMap, judge: GraphJudge, sensors: ExtraSensors
) -> None:
    """Put the size of the map and the lengths of all queues into the diagnostics."""

    def held() -> int:
        loops = online_map.graph.loops()
        return sum(loop.status is LoopStatus.REJECTED_INCONSISTENT for loop in loops)

    diagnostics.watch('keyframes in the map', lambda: len(online_map))
    diagnostics.watch('map memory [MB]', lambda: f'{online_map.nbytes * 1e-6:.1f}')
    diagnostics.watch('keyframes waiting for their place', lambda: online_map.unplaced_keyframes)
    diagnostics.watch('loops waiting for their keyframes', lambda: online_map.waiting_loops)
    diagnostics.watch('loops waiting for the solver', held)
    diagnostics.watch('solves under way', judge.under_way)
    diagnostics.watch('fixes waiting for odometry', lambda: sensors.waiting_fixes)
