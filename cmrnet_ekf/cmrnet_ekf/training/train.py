"""Train CMRNet and its uncertain variants: the command `train_cmrnet`."""

import argparse
import hashlib
import json
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from tqdm import tqdm

from cmrnet_ekf.networks import checkpoint
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.curves import draw_curves
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.trainer import Trainer
from cmrnet_ekf.training.validation import validate
from cmrnet_ekf.training.variants import NETWORKS, VARIANTS, Variant, variant
from lcd_common.command_line import run
from lcd_common.device import choose_device
from lcd_common.errors import ConfigError
from lcd_common.setting_changes import changed

_log = logging.getLogger(__name__)
_EXAMPLES = """
examples:
  make_cmrnet_samples towns:0-9 --out samples                first, once: simulated towns
  make_cmrnet_samples towns:100-101 --out judged
  train_cmrnet --samples samples/town_* --validation judged/town_* --out runs/der --variant der
  train_cmrnet ... --out runs/member3 --variant plain --seed 3     a member of an ensemble
  train_cmrnet ... --out runs/der --variant der --minutes 60       an hour; the same again goes on
  train_cmrnet ... --out runs/full --network full --variant mcd --device cuda
  train_cmrnet ... --out runs/nll --variant der --loss density=log one row of Table 5.2
  train_cmrnet ... --out runs/tuned --from runs/der/best.safetensors --train steps=500
                                                                   fine-tune on other samples
  train_cmrnet ... --out runs/der --variant der --from runs/plain/best.safetensors
                                                                   learn to doubt on a trained trunk

variants:
"""
_END = """
--out gets checkpoint.safetensors (to go on from), best.safetensors (the best on --validation, in
half precision) with its card best.json, training.jsonl, validation.jsonl and curves.png. Training
needs no LiDAR formats, simulator or map: the samples hold all.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _train(arguments))


def _train(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(arguments.threads or torch.get_num_threads())
    chosen = _chosen(arguments)
    sets = [SampleSet(path) for path in arguments.samples]
    held_out = [SampleSet(path) for path in arguments.validation]
    shared = {one.facts['drive'] for one in sets} & {one.facts['drive'] for one in held_out}
    if shared:
        raise ConfigError(f'{", ".join(sorted(shared))} is in --samples and in --validation')
    torch.manual_seed(chosen.training.seed)
    network = Cmrnet(chosen.network)
    if arguments.start:
        fresh = checkpoint.begin_from(network, arguments.start)
        if fresh:
            _log.info('%s: of another head; new: %s', arguments.start, ', '.join(fresh))
    trainer = Trainer(
        network, sets, arguments.out, chosen.training, chosen.loss, choose_device(arguments.device)
    )
    _log.info(
        '%d parameters, %d samples, %s, from step %d',
        sum(p.numel() for p in network.parameters()),
        sum(len(one) for one in sets),
        trainer.device,
        trainer.step,
    )
    deadline = None if arguments.minutes is None else time.monotonic() + 60.0 * arguments.minutes
    steps = chosen.training.steps
    judged_at = -1
    with tqdm(total=steps, initial=trainer.step, unit='step', disable=arguments.quiet) as bar:
        for record in trainer.run(deadline=deadline):
            bar.update()
            bar.set_postfix(t=f'{record.translation:.3f}', r=f'{record.rotation:.3f}')
            if record.step % arguments.validate_every == 0 or record.step == steps:
                _judge(trainer, chosen, sets, held_out, arguments)
                judged_at = record.step
    if judged_at != trainer.step:
        _judge(trainer, chosen, sets, held_out, arguments)


def _chosen(arguments: argparse.Namespace) -> Variant:
    chosen = variant(arguments.variant, arguments.network)
    training = [f'seed={arguments.seed}', *arguments.train]
    return Variant(
        changed(chosen.network, arguments.set).check(),
        changed(chosen.training, training),
        changed(chosen.loss, arguments.loss),
    )


def _judge(
    trainer: Trainer,
    chosen: Variant,
    sets: Sequence[SampleSet],
    held_out: Sequence[SampleSet],
    arguments: argparse.Namespace,
) -> None:
    """Validate, keep the best network with its card, and draw the curves."""
    out: Path = arguments.out
    trainer.network.eval()
    result = validate(Predictor([trainer.network]), held_out, arguments.validation_samples)
    row = {'step': trainer.step, 'score': result.score, **asdict(result)}
    log = out / 'validation.jsonl'
    before = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    with log.open('a') as file:
        file.write(json.dumps(row) + '\n')
    _log.info(
        'step %d: median %.3f m, %.2f degrees (guesses: %.3f m, %.2f degrees)',
        trainer.step,
        result.errors.t_median_m,
        result.errors.r_median_deg,
        result.rough.t_median_m,
        result.rough.r_median_deg,
    )
    if result.score > max((float(one['score']) for one in before), default=float('-inf')):
        facts = {
            'variant': arguments.variant,
            'trained_on': [one.facts['drive'] for one in sets],
            'guesses_m_deg': sorted({(s.facts['noise_m'], s.facts['noise_deg']) for s in sets}),
            'chosen_on': [one.facts['drive'] for one in held_out],
            'training': asdict(chosen.training),
            'loss': asdict(chosen.loss),
            'started_from': str(arguments.start or ''),
            'torch': torch.__version__,
            'validation': row,
        }  # fmt: skip
        best = out / 'best.safetensors'
        checkpoint.save_network(best, trainer.network, facts, half=True)
        digest = hashlib.sha256(best.read_bytes()).hexdigest()
        card = {**facts, 'network': asdict(chosen.network), 'sha256': digest}
        (out / 'best.json').write_text(json.dumps(card, indent=1) + '\n')
    draw_curves(out)


def _parser() -> argparse.ArgumentParser:
    lines = [f'  {name:11} {meaning}\n' for name, meaning in VARIANTS.items()]
    parser = argparse.ArgumentParser(
        prog='train_cmrnet',
        description='Train CMRNet or one of its uncertain variants on samples.',
        epilog=_EXAMPLES + ''.join(lines) + _END,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('--samples', type=Path, nargs='+', required=True, metavar='SET', help='to learn from')
    add('--validation', type=Path, nargs='+', required=True, metavar='SET', help='to judge by')
    add('--out', type=Path, required=True, help='folder of the training; one that is there goes on')
    add('--variant', choices=sorted(VARIANTS), default='plain', help='(default: plain)')
    add('--network', choices=sorted(NETWORKS), default='compact', help='(default: compact)')
    add('--seed', type=int, default=0, help='of weights and draws (default: 0)')
    add('--from', dest='start', type=Path, metavar='WEIGHTS',
        help='network to begin with; its head may be another')  # fmt: skip
    add('--minutes', type=float, help='stop after this time; the same command goes on later')
    add('--validate-every', type=int, default=500, metavar='STEPS', help='(default: 500)')
    add('--validation-samples', type=int, metavar='N', help='of each set (default: all)')
    add('--device', default='auto', help='auto, cpu, cuda, cuda:1 ... (default: auto)')
    add('--threads', type=int, help='of the CPU (default: all)')
    add('--set', nargs='+', default=[], metavar='NAME=VALUE', help='settings of the network')
    add('--train', nargs='+', default=[], metavar='NAME=VALUE', help='settings of the training')
    add('--loss', nargs='+', default=[], metavar='NAME=VALUE', help='settings of the loss')
    add('--quiet', action='store_true', help='no progress bars')
    return parser


if __name__ == '__main__':
    sys.exit(main())
