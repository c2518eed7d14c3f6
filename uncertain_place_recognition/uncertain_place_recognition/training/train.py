"""Train networks for place recognition: the command `train_place_recognition`."""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from lcd_common.command_line import run
from lcd_common.device import choose_device
from lcd_common.errors import ConfigError, DataError
from lcd_common.setting_changes import changed
from uncertain_place_recognition.ensemble import BEST, PACKED, EmbeddingEnsemble
from uncertain_place_recognition.networks.embedding import PlaceNetwork
from uncertain_place_recognition.networks.shapes import build, shape
from uncertain_place_recognition.networks.weights import load_networks
from uncertain_place_recognition.runs import SubmapRun, load_runs
from uncertain_place_recognition.training.arguments import parser
from uncertain_place_recognition.training.augmentation import AugmentationConfig
from uncertain_place_recognition.training.curves import draw_curves
from uncertain_place_recognition.training.embedded_runs import embed_runs, thinned_run
from uncertain_place_recognition.training.judge import Judge, Judgement
from uncertain_place_recognition.training.mean_teacher import MeanTeacher
from uncertain_place_recognition.training.optional import progress_bar
from uncertain_place_recognition.training.pairs import PairConfig
from uncertain_place_recognition.training.trainer import Trainer, TrainingConfig
from uncertain_place_recognition.training.validation import Interchange, interchange

# Of the networks as they were published; the others begin with TrainingConfig's.
_RATES = {('pointnetvlad', 'original'): 1e-4, ('pointnetvlad', 'port'): 1e-4}
_STUN_RATE = 3e-4  # its weights are the teacher's, only the head is new


@dataclass(frozen=True)
class _Data:
    """Runs to learn from and runs to judge by; what both say about their submaps."""

    training: list[SubmapRun]
    validation: list[SubmapRun]
    facts: dict[str, Any]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = parser().parse_args(argv)
    return run(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(arguments.threads)
    if arguments.role == 'pack':
        _pack(arguments.files, arguments.out, arguments)
        return
    data = _data(arguments)
    if arguments.role == 'ensemble':
        _ensemble(data, arguments)
    elif arguments.role in ('student', 'stun'):
        teacher, facts = _teacher(arguments.teacher)
        _student(arguments.role, teacher, facts, data, arguments.out, arguments.seed, arguments)
    else:
        _metric(arguments.role, data, arguments.out, arguments)


def _metric(role: str, data: _Data, out: Path, arguments: argparse.Namespace) -> bool:
    """Train a network by the distance of places; tell whether it is done."""
    changes = {'dropout': arguments.rate} if role == 'dropout' else {}
    settings = shape(arguments.network, arguments.preset, **changes)
    settings = changed(settings, arguments.set)
    rate = _RATES.get((arguments.network, arguments.preset), TrainingConfig().learning_rate)
    training = TrainingConfig(learning_rate=rate, seed=arguments.seed)
    training = changed(training, arguments.train)
    torch.manual_seed(training.seed)
    return _train(role, build(settings), training, None, data, out, arguments)


def _student(
    role: str,
    teacher: PlaceNetwork,
    facts: dict[str, Any],
    data: _Data,
    out: Path,
    seed: int,
    arguments: argparse.Namespace,
) -> bool:
    """Train a network towards a teacher's embeddings, half as long as the teacher was trained."""
    settings = replace(teacher.settings, variance=role == 'stun', dropout=0.0)
    theirs = facts['training']
    training = TrainingConfig(
        steps=max(1, int(theirs['steps']) // 2),
        learning_rate=_STUN_RATE if role == 'stun' else theirs['learning_rate'],
        seed=seed,
    )
    training = changed(training, arguments.train)
    torch.manual_seed(training.seed)
    network = build(settings)
    if role == 'stun':
        if isinstance(teacher, MeanTeacher):
            raise ConfigError('stun begins with the weights of its teacher, which must be one')
        network.load_state_dict(teacher.state_dict(), strict=False)
    return _train(role, network, training, teacher, data, out, arguments)


def _train(
    role: str,
    network: PlaceNetwork,
    training: TrainingConfig,
    teacher: PlaceNetwork | None,
    data: _Data,
    out: Path,
    arguments: argparse.Namespace,
) -> bool:
    device = choose_device(arguments.device)
    augmentation = changed(AugmentationConfig(), arguments.augment)
    pairs = changed(PairConfig(), arguments.pairs)
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(
        network, data.training, out, training,
        teacher=teacher, augmentation=augmentation, pairs=pairs, device=device,
    )  # fmt: skip
    facts = {
        **data.facts,
        'role': role,
        'command': 'train_place_recognition ' + ' '.join(sys.argv[1:]),
        'trained_on': [one.name for one in data.training],
        'chosen_on': [one.name for one in data.validation],
        'training': asdict(training),
        'augmentation': asdict(augmentation),
        'pairs': asdict(pairs),
        'parameters': sum(p.numel() for p in network.parameters()),
        'torch': torch.__version__,
    }
    judge = Judge(out, data.validation, facts, teacher, device, arguments.validation_radius)
    deadline = None if arguments.minutes is None else time.monotonic() + 60.0 * arguments.minutes
    every = arguments.validate_every or max(1, training.steps // 8)
    begin = trainer.step
    shown: Judgement | None = None
    with progress_bar(training.steps, trainer.step, out.name, arguments.quiet) as bar:
        for record in trainer.run(deadline=deadline):
            bar.update()
            if record.step % every == 0 or record.step == training.steps:
                shown = judge.judge(trainer.network, record.step)
            bar.set_postfix_str(_postfix(record.loss, record.active, shown), refresh=False)
    if trainer.step > begin and (shown is None or shown.step < trainer.step):
        shown = judge.judge(trainer.network, trainer.step)  # time was up between two judgements
    if shown is not None:
        sys.stdout.write(f'{out}: step {trainer.step} of {training.steps}, {_told(shown)}\n')
    else:
        state = 'trained already' if trainer.step == training.steps else 'no time for a step'
        if trainer.step and not (out / 'curves.png').exists():
            draw_curves(out)  # trained where nothing can draw
        sys.stdout.write(f'{out}: {state}, step {trainer.step} of {training.steps}\n')
    return trainer.step == training.steps


def _ensemble(data: _Data, arguments: argparse.Namespace) -> None:
    """Train a teacher and its students, each in a folder of its own, and pack the students."""
    out: Path = arguments.out
    if not _metric('teacher', data, out / 'teacher', arguments):
        sys.stdout.write('the teacher is not done, so no student begins; run the command again\n')
        return
    given = list(arguments.train)
    arguments.train = [change for change in given if change.partition('=')[0] != 'steps']
    arguments.train += arguments.train_students
    teacher, facts = _teacher(out / 'teacher')
    folders = [out / f'student_{number}' for number in range(1, arguments.members + 1)]
    done = [
        _student('student', teacher, facts, data, folder, arguments.seed + number, arguments)
        for number, folder in enumerate(folders, 1)
    ]
    if not all(done):
        sys.stdout.write('not all students are done, so none is packed; run the command again\n')
        return
    arguments.validation_runs = data.validation
    _pack(folders, out / PACKED, arguments)


def _pack(files: Sequence[Path], out: Path, arguments: argparse.Namespace) -> None:
    """Put members into one file, with how they understand one another if there are runs."""
    members: list[PlaceNetwork] = []
    cards: list[dict[str, Any]] = []
    for file in files:
        found, facts = load_networks(file / BEST if file.is_dir() else file)
        members += found
        cards.append(facts)
    about = ('submap', 'normalisation')
    if any(card.get(name) != cards[0].get(name) for card in cards for name in about):
        raise ConfigError('the members were trained on submaps made in different ways')
    facts = {name: cards[0][name] for name in about if name in cards[0]}
    facts |= {'role': 'ensemble', 'members_trained': cards}
    ensemble = EmbeddingEnsemble(members, facts)
    path = out / PACKED if out.is_dir() or not out.suffix else out
    runs: list[SubmapRun] = getattr(arguments, 'validation_runs', None) or [
        thinned_run(one, arguments.validation_submaps)
        for one in (load_runs(arguments.validation) if arguments.validation else [])
    ]
    if runs:
        device = choose_device(arguments.device)
        found_all = [embed_runs(one.to(device), runs, device) for one in members]
        judged = interchange(runs, found_all, arguments.validation_radius)
        sys.stdout.write(_table(judged))
        ensemble.facts['interchange'] = {
            'recall_1': judged.recall_1.round(4).tolist(),
            'chance': judged.chance,
            'diversity': judged.diversity,
        }
    ensemble.save(path, half=not arguments.whole)
    path.with_suffix('.json').write_text(json.dumps(ensemble.facts, indent=1) + '\n')
    size = path.stat().st_size / 1e6
    sys.stdout.write(f'{path}: {len(members)} members, {size:.1f} MB\n')


def _data(arguments: argparse.Namespace) -> _Data:
    training, validation = load_runs(arguments.runs), load_runs(arguments.validation)
    shared = {one.world for one in training} & {one.world for one in validation}
    if shared and not _parted(training, validation):
        raise DataError(
            f'{", ".join(sorted(shared))} is in the runs for training and for validation; keep '
            'towns apart'
        )
    told: list[dict[str, Any]] = [
        {name: one.facts[name] for name in ('submap', 'normalisation') if name in one.facts}
        for one in (*training, *validation)
    ]
    sizes = {one.points.shape[1] for one in (*training, *validation)}
    if any(one != told[0] for one in told) or len(sizes) > 1:
        raise DataError(
            'the runs hold submaps made in different ways (reach, number of points, normalisation);'
            ' make them anew with the same settings'
        )
    thin = [thinned_run(one, arguments.validation_submaps) for one in validation]
    return _Data(training, thin, told[0])


def _parted(training: Sequence[SubmapRun], validation: Sequence[SubmapRun]) -> bool:
    """Tell whether runs for training lie outside the benchmark's test regions, others inside."""
    out, inside = ({one.facts.get('region', '') for one in runs} for runs in (training, validation))
    kinds = [{text.partition(' ')[0] for text in found} for found in (out, inside)]
    sites = {text.partition(' ')[2] for text in out | inside}
    return kinds == [{'outside'}, {'inside'}] and len(sites) == 1


def _teacher(path: Path) -> tuple[PlaceNetwork, dict[str, Any]]:
    networks, facts = load_networks(path / BEST if path.is_dir() else path)
    if len(networks) > 1:
        # Each has a card of its own; they were trained alike but for the seed.
        facts = {**facts, **(facts.get('members_trained') or [{}])[0]}
    if 'training' not in facts:
        raise ConfigError(f'{path}: does not say how it was trained; train a teacher first')
    return networks[0] if len(networks) == 1 else MeanTeacher(networks), facts


def _postfix(loss: float, active: float, judged: Judgement | None) -> str:
    text = f'loss {loss:.4f} active {active:.2f}'
    return text if judged is None else f'{text} R@1 {judged.recall_1:.2f}'


def _told(judged: Judgement) -> str:
    text = f'recall@1 {judged.recall_1:.3f} of {judged.queries} queries'
    if judged.gap is not None:
        text += f", {judged.teacher_recall_1:.3f} in the teacher's map, gap {judged.gap:.3f}"
    return text


def _table(judged: Interchange) -> str:
    lines = ['recall@1, map of the row, queries of the column:']
    lines += ['  ' + ' '.join(f'{value:.3f}' for value in row) for row in judged.recall_1]
    lines.append(
        f'  diagonal {judged.diagonal:.3f}, off-diagonal {judged.off_diagonal:.3f}, by chance '
        f'{judged.chance:.3f}; diversity (mean normalised u_EV) {judged.diversity:.4f}'
    )
    return '\n'.join(lines) + '\n'


if __name__ == '__main__':
    raise SystemExit(main())
