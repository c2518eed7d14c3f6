"""Arguments of `train_place_recognition`."""

import argparse
from pathlib import Path

from uncertain_place_recognition.networks.shapes import NETWORKS
from uncertain_place_recognition.training.validation import RADIUS_M

_EXAMPLES = """
examples:
  make_submap_runs --out runs/train town:0-15:0-1
  make_submap_runs --out runs/validation town:100-101:0-1

  train_place_recognition ensemble --runs runs/train --validation runs/validation --out shared
      a teacher and five students that share its feature space; shared/ensemble.safetensors
  train_place_recognition teacher --network bev_netvlad --seed 3 ... --out naive/3
      one network by triplets; several of them are a naive ensemble, or Mason et al.'s:
  train_place_recognition pack naive/1 naive/2 naive/3 --validation runs/validation --out naive
  train_place_recognition student --teacher shared/teacher --seed 9 ... --out shared/student_9
  train_place_recognition student --teacher naive/ensemble.safetensors --seed 9 ... --out mean_9
      the mean of several teachers is learnt, which recognises more than each
  train_place_recognition teacher --pairs positive=5 negative=20 --validation-radius 10 ...
      radii for smaller submaps
  train_place_recognition stun --teacher shared/teacher ... --out stun
  train_place_recognition dropout --rate 0.5 ... --out dropout
  train_place_recognition teacher --preset original --device cuda \\
      --train steps=20000 loss=smooth_ap clouds=256 ... --out full

The same command again goes on where the last one ended. --out gets checkpoint.safetensors (to go
on from), best.safetensors (the best on the validation runs) with its card best.json,
training.jsonl, validation.jsonl and curves.png.
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser."""
    whole = argparse.ArgumentParser(
        prog='train_place_recognition',
        description='Train networks that recognise places, alone and in ensembles.',
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    roles = whole.add_subparsers(dest='role', required=True, metavar='ROLE')
    common, metric, learner = _common(), _metric(), _learner()
    about = {
        'teacher': ('a network by the distance of places', [common, metric]),
        'dropout': ('the same with Monte Carlo dropout', [common, metric]),
        'student': ("a network towards a teacher's embeddings", [common, learner]),
        'stun': ('a student that estimates a variance (aleatoric)', [common, learner]),
        'ensemble': ('a teacher and students, packed into one file', [common, metric]),
    }
    made = {
        name: roles.add_parser(name, help=text, description=f'Train {text}.', parents=parents)
        for name, (text, parents) in about.items()
    }
    add = made['dropout'].add_argument
    add('--rate', type=float, default=0.5, help='share dropped (default: 0.5)')
    add = made['ensemble'].add_argument
    add('--members', type=int, default=5, help='students (default: 5)')
    add(
        '--train-students', nargs='*', default=[], metavar='NAME=VALUE',
        help='training of the students; steps are half the teacher\'s unless given',
    )  # fmt: skip
    _whole(made['ensemble'])
    pack = roles.add_parser('pack', help='put trained members into one file')
    pack.add_argument('files', nargs='+', type=Path, help='folders of trainings, or their files')
    pack.add_argument('--out', type=Path, required=True, help='file, or folder for it')
    _validation(pack, required=False)
    _machine(pack)
    _whole(pack)
    return whole


def _common() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    add = parser.add_argument
    add('--runs', nargs='+', type=Path, required=True, help='to learn from: files or folders')
    add('--out', type=Path, required=True, help='folder of the training; one that is there goes on')
    add('--seed', type=int, default=0, help='of weights and order (default: 0)')
    for name, what in (
        ('train', 'training, e.g. steps=2000 clouds=64 loss=smooth_ap'),
        ('augment', 'augmentation, e.g. yaw=5'),
        ('pairs', 'radii, e.g. positive=5 negative=25'),
    ):
        add(f'--{name}', nargs='*', default=[], metavar='NAME=VALUE', help=f'settings of {what}')
    add('--minutes', type=float, help='stop after so long; the same command goes on')
    add('--validate-every', type=int, help='batches (default: an eighth of the training)')
    _validation(parser, required=True)
    _machine(parser)
    return parser


def _metric() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    add = parser.add_argument
    add('--network', choices=NETWORKS, default='minkloc3d', help='(default: minkloc3d)')
    add('--preset', default='compact', help='compact, original, or port (default: compact)')
    add('--set', nargs='*', default=[], metavar='NAME=VALUE', help='shape of the network')
    return parser


def _learner() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(
        '--teacher',
        type=Path,
        required=True,
        help='folder or file of the teacher; of several packed ones the mean embedding teaches',
    )
    return parser


def _validation(parser: argparse.ArgumentParser, required: bool) -> None:
    add = parser.add_argument
    add(
        '--validation', nargs='+', type=Path, required=required, default=[], help='runs to judge by'
    )
    add('--validation-submaps', type=int, default=250, help='of a run, at most (default: 250)')
    add(
        '--validation-radius', type=float, default=RADIUS_M, metavar='M',
        help=f'matches nearer than this are right, m (default: {RADIUS_M:g})',
    )  # fmt: skip


def _machine(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--device', default='auto', help='auto, cpu or cuda[:N] (default: auto)')
    add('--threads', type=int, default=1, help='of the CPU (default: 1)')
    add('--quiet', action='store_true', help='no progress bar')


def _whole(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--whole', action='store_true', help='keep members in single precision')
