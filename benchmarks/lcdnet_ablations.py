"""Train variants of the compact network alike and briefly: the rows of Tables 3.8 and 3.9."""

import json
import math
from pathlib import Path
from typing import Any

from lcd_common.errors import LocalizationError
from lcd_loop_closure.lcdnet import train

# Changes of the network and of its training. The compact network is the row `lcdnet`: backbone
# adapted from PV-RCNN, UOT head, D = 128, N = 1024, with the auxiliary transport loss (16).
VARIANTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    'lcdnet': ((), ()),
    'backbone_pointnet': (('backbone=pointnet',), ()),
    'backbone_edgeconv': (('backbone=edgeconv',), ()),
    'backbone_randla': (('backbone=randla',), ()),
    'head_mlp_sincos': (('pose_head=mlp_sincos',), ()),
    'head_mlp_quaternion': (('pose_head=mlp_quaternion',), ()),
    'head_mlp_bingham': (('pose_head=mlp_bingham',), ()),
    'd_640': (('feature_size=640',), ()),
    'd_64': (('feature_size=64',), ()),
    'd_32': (('feature_size=32',), ()),
    'no_transport_loss': ((), ('beta=0.0',)),
    'n_512': (('keypoints=512',), ()),
    'n_2048': (('keypoints=2048',), ()),
    'n_4096': (('keypoints=4096',), ()),
}
FIGURES = ('average_precision', 'loops_success', 'pose_te_m', 'pose_re_deg')


def ablations(work: Path, steps: int = 80, towns: int = 12) -> dict[str, Any]:
    """Return the validation figures of each variant after as many steps, all else alike.

    Args:
        work: folder of places and trainings; a training that ended is not done again.
        steps: budget of each training.
        towns: training towns; validation towns are four.

    Raises:
        LocalizationError: a training failed.
    """
    found: dict[str, Any] = {}
    for name, (network, training) in VARIANTS.items():
        out = work / 'ablations' / f'{name}_{steps}'
        rows = out / 'validation.jsonl'
        if not rows.is_file():
            command = [
                '--out', str(out), '--data', str(work / 'ablations' / 'places'),
                '--towns', str(towns), '--validation-towns', '4', '--places', '30',
                '--validation-places', '20', '--train', f'steps={steps}', 'warmup=20', *training,
            ]  # fmt: skip
            if train.main([*command, *(('--set', *network) if network else ())]) != 0:
                raise LocalizationError(f'the training of {name} in {out} failed')
        last = json.loads(rows.read_text().splitlines()[-1])
        last['pose_re_deg'] = math.degrees(last['pose_re_rad'])
        found[name] = {figure: last[figure] for figure in FIGURES}
    budget = {'steps': steps, 'places_of_a_batch': 4, 'towns': towns, 'validation_towns': 4}
    return {'ablations': found, 'ablations_budget': budget}
