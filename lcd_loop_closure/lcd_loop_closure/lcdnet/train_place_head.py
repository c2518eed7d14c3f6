"""Train LCDNet's place head on drives: the command `train_lcdnet_place_head`."""

import argparse
import copy
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lcd_common.command_line import run
from lcd_common.device import choose_device
from lcd_common.errors import ConfigError
from lcd_common.setting_changes import changed
from lcd_loop_closure.lcdnet import checkpoint
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig
from lcd_loop_closure.lcdnet.config import LcdnetConfig
from lcd_loop_closure.lcdnet.curves import draw_place_head
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.place_features import (
    PlaceFeatures,
    around_loops,
    drive_features,
    joined_features,
    near_spots,
    second_run,
)
from lcd_loop_closure.lcdnet.place_head import PlaceHeadConfig, judge_place_head, train_place_head
from lcd_loop_closure.lcdnet.training_drives import simulated_drive

_EXAMPLES = """
examples:
  train_lcdnet_place_head runs/compact/best.safetensors --out runs/head
  train_lcdnet_place_head runs/compact/best.safetensors --out runs/head --set place_ranges=12
  train_lcdnet_place_head runs/compact/best.safetensors --out runs/head --train steps=2000
  train_lcdnet_place_head runs/head/best.safetensors --out runs/head2 --again 20 --mix 0.5

Drives through training towns 0, 1, ... and validation towns 100, 101, ... are simulated first, then
the features of all their sweeps are computed; both are kept in --data, so that the same command
goes on where it was stopped. --out gets best.safetensors (the whole network, its head the best on
the validation drives, whole and with sectors left out as in training), its card best.json,
place_head.jsonl and place_head.png.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _train(arguments))


def _train(arguments: argparse.Namespace) -> None:
    settings = changed(PlaceHeadConfig(), arguments.train)
    torch.set_num_threads(arguments.threads or torch.get_num_threads())
    device = choose_device(arguments.device)
    network, facts = checkpoint.load_network(arguments.weights, device)
    if arguments.set:
        network = _begun_anew(network, changed(network.settings, arguments.set), device)
    made_by = hashlib.sha256(arguments.weights.read_bytes()).hexdigest()
    judged: list[tuple[PlaceFeatures, int | None]] = []
    for town in range(100, 100 + arguments.validation_towns):
        once = _features(network, made_by, town, None, arguments)
        judged.append((once, None))
        if arguments.again:
            again = _features(network, made_by, town, None, arguments, once)
            judged.append((second_run(once, again), len(once)))
    # A shift would move the sensor's shadows away from the sensor.
    augmentation = AugmentationConfig(shift=0.0)
    drives = []
    for town in range(arguments.towns):
        drives.append(_features(network, made_by, town, augmentation, arguments))
        if town < arguments.again:
            again = _features(network, made_by, town, augmentation, arguments, drives[-1])
            drives[-1] = second_run(drives[-1], again)
    features = joined_features(drives)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    rows = [{'step': 0, **_scores(network, judged, settings)}]
    best, before = _mean(rows[0]), copy.deepcopy(network.place.state_dict())
    with tqdm(total=settings.steps, unit='step', desc='place head', disable=arguments.quiet) as bar:
        for step, loss, confused in train_place_head(network, features, settings):
            bar.update()
            bar.set_postfix(loss=f'{loss:.3f}', confused=f'{confused:.2f}', best=f'{best:.3f}')
            if step % arguments.validate_every and step != settings.steps:
                continue
            mixed = _mixed(network, before, arguments.mix)
            scores = _scores(mixed, judged, settings)
            network.place.train()
            rows.append({'step': step, 'loss': loss, 'confused': confused, **scores})
            if _mean(scores) > best:
                best = _mean(scores)
                _keep(out, mixed, facts, rows[-1], settings, arguments)
            _write(out, rows)
    if not (out / 'best.safetensors').is_file():
        _keep(out, mixed, facts, rows[-1], settings, arguments)


def _begun_anew(network: Lcdnet, settings: LcdnetConfig, device: torch.device) -> Lcdnet:
    """Return the network with another place head, not trained.

    Raises:
        ConfigError: more than the head would be another.
    """
    torch.manual_seed(0)
    other = Lcdnet(settings)
    kept = {k: v for k, v in network.state_dict().items() if not k.startswith('place.')}
    head = ('place_ranges', 'clusters', 'descriptor_size')
    if replace(settings, **{name: getattr(network.settings, name) for name in head}) != (
        network.settings
    ):
        raise ConfigError(f'--set may change the place head alone: {", ".join(head)}')
    other.load_state_dict(kept, strict=False)
    return other.to(device).eval()


def _features(
    network: Lcdnet,
    made_by: str,
    town: int,
    augmentation: AugmentationConfig | None,
    arguments: argparse.Namespace,
    before: PlaceFeatures | None = None,
) -> PlaceFeatures:
    """Return the features of the drive through a town, from the folder where they are there.

    With those of the run before, of the second one: its sweeps near those of the first.
    """
    data: Path = arguments.data or arguments.out / 'drives'
    run = 0 if before is None else 1
    path = data / f'features_{town:03d}{"_run1" if run else ""}.safetensors'
    if (kept := PlaceFeatures.load(path, made_by)) is not None:
        return kept
    with tqdm(desc=f'casting town {town}', unit='sweep', disable=arguments.quiet) as bar:
        drive = simulated_drive(data, town, lambda done, of: _advance(bar, of), run)
    # Far from its loops a drive teaches little, but it can be mistaken for them.
    if augmentation is None:
        chosen = None
    elif before is None:
        chosen = around_loops(drive, loop_m=4.0, around_m=20.0)
    else:
        chosen = near_spots(drive, before.position.numpy(), around_m=3.0)
    total = len(drive) if chosen is None else len(chosen)
    with tqdm(total=total, unit='sweep', desc='features', disable=arguments.quiet) as bar:
        features = drive_features(
            network, drive, town, augmentation, chosen=chosen, seed=run, progress=bar.update
        )
    features.save(path, made_by)
    return features


def _advance(bar: Any, of: int) -> None:
    bar.total = of
    bar.update()


def _mixed(network: Lcdnet, before: dict[str, Tensor], share: float) -> Lcdnet:
    """Return the network with its place head part of the way back to what it was.

    Between the two, what was known and what is new go together (Wortsman et al., Robust
    fine-tuning of zero-shot models, CVPR 2022).
    """
    if not share:
        return network
    mixed = copy.deepcopy(network)
    for name, value in mixed.place.state_dict().items():
        if value.is_floating_point():
            value.lerp_(before[name], share)
    return mixed


def _scores(
    network: Lcdnet,
    judged: Sequence[tuple[PlaceFeatures, int | None]],
    settings: PlaceHeadConfig,
) -> dict[str, float]:
    """Return mean average precisions over the validation drives, whole and without sectors."""
    return {
        name: float(
            np.mean([judge_place_head(network, *one, hidden).average_precision for one in judged])
        )
        for name, hidden in (('average_precision', None), ('without_sectors', settings))
    }


def _mean(scores: dict[str, float]) -> float:
    return (scores['average_precision'] + scores['without_sectors']) / 2.0


def _keep(
    out: Path,
    network: Lcdnet,
    facts: dict[str, Any],
    row: dict[str, float],
    settings: PlaceHeadConfig,
    arguments: argparse.Namespace,
) -> None:
    """Write the network with its card: the whole network's, and the head's added."""
    head = {
        'trained_on': f'simulation only: drives through towns 0 to {arguments.towns - 1}, '
        f'{arguments.again} of them twice, among other cars',
        'chosen_on': f'drives through {arguments.validation_towns} validation towns from 100 on',
        'command': 'train_lcdnet_place_head ' + ' '.join(sys.argv[1:]),
        'training': asdict(settings),
        'share_of_the_head_before': arguments.mix,
        'validation': row,
    }
    card = {**facts, 'place_head': head, 'torch': torch.__version__}
    checkpoint.save_network(out / 'best.safetensors', network, card)
    (out / 'best.json').write_text(json.dumps(card, indent=1) + '\n')


def _write(out: Path, rows: list[dict[str, float]]) -> None:
    (out / 'place_head.jsonl').write_text(''.join(json.dumps(row) + '\n' for row in rows))
    draw_place_head(rows, out / 'place_head.png')


def _share(text: str) -> float:
    if not 0.0 <= (value := float(text)) < 1.0:
        raise argparse.ArgumentTypeError(f'expected 0 or more and less than 1, got {text}')
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='train_lcdnet_place_head',
        description="Train LCDNet's place head further on simulated drives, the rest at rest.",
        epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    add = parser.add_argument
    add('weights', type=Path, help='network to go on from: the best.safetensors of train_lcdnet')
    add('--out', type=Path, required=True, help='folder of the training')
    add('--data', type=Path, help='folder of drives and features (default: drives in --out)')
    add('--towns', type=int, default=20, help='training towns, at most 100 (default: 20)')
    add('--again', type=int, default=0, metavar='TOWNS',
        help='so many of them are driven twice, the second time among other cars, and so are the '
        'validation towns (default: 0)')  # fmt: skip
    add('--validation-towns', type=int, default=3, help='at most 10 (default: 3)')
    add('--mix', type=_share, default=0.0, metavar='SHARE',
        help='of the weights before in the head that is judged and kept: it forgets less '
        '(default: 0)')  # fmt: skip
    add('--validate-every', type=int, default=100, metavar='STEPS', help='(default: 100)')
    add('--device', default='auto', help='auto, cpu, cuda, cuda:1 ... (default: auto)')
    add('--threads', type=int, help='of the CPU (default: all)')
    add(
        '--set',
        nargs='+',
        default=[],
        metavar='NAME=VALUE',
        help='place_ranges, clusters or descriptor_size of a head that begins anew',
    )
    add('--train', nargs='+', default=[], metavar='NAME=VALUE', help='settings of the training')
    add('--quiet', action='store_true', help='no progress bars')
    return parser


if __name__ == '__main__':
    sys.exit(main())
