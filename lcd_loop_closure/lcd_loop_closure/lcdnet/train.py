"""Train LCDNet on simulated places: the command `train_lcdnet`."""

import argparse
import json
import logging
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from lcd_common.command_line import run
from lcd_common.device import choose_device
from lcd_common.setting_changes import changed
from lcd_loop_closure.lcdnet import checkpoint
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig
from lcd_loop_closure.lcdnet.config import COMPACT, FULL, LcdnetConfig
from lcd_loop_closure.lcdnet.curves import draw_curves
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.places import PlaceShard, simulated_shard
from lcd_loop_closure.lcdnet.training import Trainer, TrainingConfig
from lcd_loop_closure.lcdnet.validation import validate

_log = logging.getLogger(__name__)
_SENSORS = ('hdl64', 'hdl64', 'os1_64', 'vlp16')
_NETWORKS: dict[str, tuple[LcdnetConfig, TrainingConfig]] = {
    'full': (FULL, TrainingConfig()),
    # Few places at a time and few batches, as two CPU cores allow; the matching loss makes up.
    'compact': (
        COMPACT,
        TrainingConfig(
            steps=6000,
            places=4,
            learning_rate=0.002,
            schedule='cosine',
            pose_weight=0.05,
            matching_weight=1.0,
            keypoints=512,
        ),
    ),
}
_EXAMPLES = """
examples:
  train_lcdnet --out runs/compact                          the model that ships, on two CPU cores
  train_lcdnet --out runs/compact --minutes 60             an hour of it; the same again goes on
  train_lcdnet --network full --out runs/full --device cuda
  torchrun --nproc-per-node 4 -m lcd_loop_closure.lcdnet.train --network full --out runs/full
  train_lcdnet --out runs/d64 --set feature_size=64        one row of the ablation tables
  train_lcdnet --out runs/long --train steps=20000 places=8

Places are simulated first (or read from --data where they were made before): sweeps of towns 0 to
99 for training, 100 to 109 for validation. --out gets checkpoint.safetensors (to go on from),
best.safetensors (the best on validation towns) with its card best.json, training.jsonl,
validation.jsonl and curves.png.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _train(arguments))


def _train(arguments: argparse.Namespace) -> None:
    network_settings, training = _NETWORKS[arguments.network]
    network_settings = changed(network_settings, arguments.set)
    training = changed(training, arguments.train)
    torch.set_num_threads(arguments.threads or torch.get_num_threads())
    device, rank, processes = _join(arguments.device)
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    data: Path = arguments.data or out / 'places'
    quiet = arguments.quiet or rank > 0
    towns, judged = range(arguments.towns), range(100, 100 + arguments.validation_towns)
    if rank == 0:
        simulate(data, [*judged, *towns], arguments.places, quiet)
    if processes > 1:
        torch.distributed.barrier()
    shards = [PlaceShard.load(shard_path(data, town)) for town in towns]
    held_out = [PlaceShard.load(shard_path(data, town)) for town in judged]
    torch.manual_seed(training.seed)
    network = Lcdnet(network_settings)
    trainer = Trainer(
        network, shards, out, training, AugmentationConfig(),
        device=device, rank=rank, processes=processes,
    )  # fmt: skip
    (out / 'settings.json').write_text(
        json.dumps({'network': asdict(network_settings), 'training': asdict(training)}, indent=1)
    )
    parameters = sum(p.numel() for p in network.parameters())
    _log.info('%d parameters, %s, from step %d', parameters, device, trainer.step)
    deadline = None if arguments.minutes is None else time.monotonic() + 60.0 * arguments.minutes
    bar = tqdm(total=training.steps, initial=trainer.step, unit='step', disable=quiet)
    for record in trainer.run(deadline=deadline):
        bar.update()
        bar.set_postfix(
            loss=f'{record.total:.2f}',
            triplet=f'{record.triplet:.3f}',
            pose=f'{record.pose_m:.1f}m',
        )
        last = record.step == training.steps
        if rank == 0 and (record.step % arguments.validate_every == 0 or last):
            _judge(trainer.network, trainer.step, asdict(training), held_out, arguments)
    bar.close()


def _judge(
    network: Lcdnet,
    step: int,
    training: dict[str, Any],
    held_out: Sequence[PlaceShard],
    arguments: argparse.Namespace,
) -> None:
    """Validate, keep the best network with its card, and draw the curves."""
    out: Path = arguments.out
    result = validate(network, held_out, arguments.validation_places)
    row = {'step': step, 'score': result.score, **asdict(result)}
    log = out / 'validation.jsonl'
    before = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    best = max((float(one['score']) for one in before), default=float('-inf'))
    with log.open('a') as file:
        file.write(json.dumps(row) + '\n')
    if result.score > best:
        facts = {
            'trained_on': f'simulation only: towns 0 to {arguments.towns - 1} of bags.simulation',
            'chosen_on': 'validation towns from 100 on',
            'command': 'train_lcdnet ' + ' '.join(sys.argv[1:]),
            'training': training,
            'torch': torch.__version__,
            'validation': row,
        }
        checkpoint.save_network(out / 'best.safetensors', network, facts)
        (out / 'best.json').write_text(json.dumps(facts, indent=1) + '\n')
    draw_curves(out)


def shard_path(folder: Path, town: int) -> Path:
    """Return where the places of a town are kept."""
    return folder / f'places_{town:03d}.safetensors'


def simulate(folder: Path, towns: Sequence[int], places: int, quiet: bool) -> None:
    """Make the shards that are missing; needs the package bags."""
    missing = [town for town in towns if not shard_path(folder, town).exists()]
    if not missing:
        return
    folder.mkdir(parents=True, exist_ok=True)
    with tqdm(
        total=len(missing) * places, unit='place', desc='sweeping towns', disable=quiet
    ) as bar:
        for town in missing:
            shard = simulated_shard(town, places, _SENSORS, progress=lambda: _advance(bar))
            shard.save(shard_path(folder, town))


def _advance(bar: Any) -> None:
    bar.update()


def _join(device: str) -> tuple[torch.device, int, int]:
    """Return the device, rank and number of processes; joins torchrun's group if there is one."""
    processes = int(os.environ.get('WORLD_SIZE', '1'))
    if processes == 1:
        return choose_device(device), 0, 1
    rank, local = int(os.environ['RANK']), int(os.environ['LOCAL_RANK'])
    chosen = choose_device(device)
    if chosen.type == 'cuda':
        chosen = torch.device('cuda', local)
        torch.cuda.set_device(chosen)
    torch.distributed.init_process_group('nccl' if chosen.type == 'cuda' else 'gloo')
    return chosen, rank, processes


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='train_lcdnet', description='Train LCDNet on simulated places.', epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    add = parser.add_argument
    add('--network', choices=sorted(_NETWORKS), default='compact', help='(default: compact)')
    add('--out', type=Path, required=True, help='folder of the training; one that is there goes on')
    add('--data', type=Path, help='folder of simulated places (default: places in --out)')
    add('--towns', type=int, default=100, help='training towns, at most 100 (default: 100)')
    add('--validation-towns', type=int, default=6, help='at most 10 (default: 6)')
    add('--places', type=int, default=50, help='places of a town (default: 50)')
    add('--validation-places', type=int, default=12, help='of a town (default: 12)')
    add('--validate-every', type=int, default=500, metavar='STEPS', help='(default: 500)')
    add('--minutes', type=float, help='stop after this time; the same command goes on later')
    add('--device', default='auto', help='auto, cpu, cuda, cuda:1 ... (default: auto)')
    add('--threads', type=int, help='of the CPU (default: all)')
    add('--set', nargs='+', default=[], metavar='NAME=VALUE', help='settings of the network')
    add('--train', nargs='+', default=[], metavar='NAME=VALUE', help='settings of the training')
    add('--quiet', action='store_true', help='no progress bars')
    return parser


if __name__ == '__main__':
    sys.exit(main())
