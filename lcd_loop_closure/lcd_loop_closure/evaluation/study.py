"""Evaluate methods on the sweeps of one drive: the tables of the thesis's section 3.3."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lcd_common.errors import DataError, LocalizationError
from lcd_loop_closure.evaluation.descriptions import Descriptions, describe_sweeps
from lcd_loop_closure.evaluation.detection import Detection, judge_descriptor
from lcd_loop_closure.evaluation.methods import Method, Methods
from lcd_loop_closure.evaluation.registration_errors import RegistrationErrors
from lcd_loop_closure.evaluation.registration_evaluation import evaluate_registration
from lcd_loop_closure.evaluation.registration_pairs import RegistrationPairs
from lcd_loop_closure.evaluation.sweep_views import Sweeps
from lcd_loop_closure.revisits import RevisitConfig

# `bar(label, total)` is entered around long work and gives what is called after each step.
Bar = Callable[[str, int], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True)
class JudgedMethod:
    """A descriptor on one view of a drive.

    Attributes:
        detection: by both protocols.
        describe_ms: median time to describe a sweep.
    """

    detection: Detection
    describe_ms: float

    def plain(self) -> dict[str, Any]:
        """Return the single figures."""
        return {**self.detection.plain(), 'describe_ms': self.describe_ms}


@dataclass
class Study:
    """What was found out about one drive; a text in place of a result says why there is none.

    Attributes:
        detection: view -> method -> result; the whole sweeps are the view `whole`.
        registration: kind of pairs -> method -> errors.
        pairs: kind of pairs -> what was registered.
    """

    detection: dict[str, dict[str, JudgedMethod | str]] = field(default_factory=dict)
    registration: dict[str, dict[str, RegistrationErrors | str]] = field(default_factory=dict)
    pairs: dict[str, RegistrationPairs] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """Return all single figures."""

        def shown(result: JudgedMethod | RegistrationErrors | str) -> Any:
            return {'missing': result} if isinstance(result, str) else result.plain()

        registration: dict[str, Any] = {}
        for kind, results in self.registration.items():
            pairs = self.pairs[kind]
            registration[kind] = {
                'pairs': len(pairs),
                'pairs_to_draw_from': pairs.total,
                'methods': {name: shown(result) for name, result in results.items()},
                'same_way': _by_class(results, ~pairs.reverse),
                'reverse': _by_class(results, pairs.reverse),
            }
        return {
            'detection': {
                view: {name: shown(result) for name, result in results.items()}
                for view, results in self.detection.items()
            },
            'registration': registration,
        }


@contextmanager
def terminal_bar(label: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on the terminal."""
    with tqdm(total=total, desc=label, leave=False, dynamic_ncols=True) as shown:
        yield lambda: (shown.update(1), None)[1]


@contextmanager
def no_bar(label: str, total: int) -> Iterator[Callable[[], None]]:
    """Show nothing."""
    del label, total
    yield lambda: None


def study_detection(
    methods: Methods,
    names: Sequence[str],
    views: Mapping[str, Sweeps],
    settings: RevisitConfig,
    *,
    folder: Path | None = None,
    bar: Bar = no_bar,
) -> dict[str, dict[str, JudgedMethod | str]]:
    """Judge descriptors on views of a drive; what cannot be judged says why.

    Args:
        methods: to build them.
        names: of descriptors.
        views: of the sweeps, by what results call them.
        settings: which scans count.
        folder: where descriptors are kept.
        bar: of progress.
    """
    found: dict[str, dict[str, JudgedMethod | str]] = {view: {} for view in views}
    for name in names:
        try:
            method = methods.descriptor(name)
        except (LocalizationError, ImportError) as error:
            for view in views:
                found[view][name] = str(error)
            continue
        for view, sweeps in views.items():
            try:
                found[view][name] = judge_method(
                    method, sweeps, settings, label=f'{name} · {view}', folder=folder, bar=bar
                )
            except DataError as error:
                found[view][name] = str(error)
    return found


def judge_method(
    method: Method,
    sweeps: Sweeps,
    settings: RevisitConfig,
    *,
    label: str = '',
    folder: Path | None = None,
    bar: Bar = no_bar,
) -> JudgedMethod:
    """Describe the sweeps and judge the descriptors."""
    number = len(sweeps.T_world_base)
    with bar(f'{label}: describing', number) as step:
        described = describe_sweeps(
            method.descriptor, sweeps, folder=folder, key=method.key, progress=step
        )
    with bar(f'{label}: comparing', max(number - settings.first_scan, 0)) as step:
        detection = judge_descriptor(
            distances_of(method, described), sweeps.T_world_base, settings, progress=step
        )
    return JudgedMethod(detection, float(np.median(described.describe_ms)) if number else 0.0)


def distances_of(method: Method, described: Descriptions) -> Callable[[int, int], Any]:
    """Return what gives the distances of a sweep to the first ones."""
    rows, compare = described.rows, method.descriptor.compare
    return lambda i, m: compare(rows[i], rows[:m])[0]


def study_registration(
    methods: Methods,
    names: Sequence[str],
    sweeps: Sweeps,
    pairs: Mapping[str, RegistrationPairs],
    *,
    bar: Bar = no_bar,
) -> dict[str, dict[str, RegistrationErrors | str]]:
    """Register pairs by methods; what cannot says why."""
    found: dict[str, dict[str, RegistrationErrors | str]] = {kind: {} for kind in pairs}
    for name in names:
        try:
            registration = methods.registration(name)
        except (LocalizationError, ImportError) as error:
            for kind in pairs:
                found[kind][name] = str(error)
            continue
        for kind, of_kind in pairs.items():
            with bar(f'{name} · {kind} m', len(of_kind)) as step:
                errors, _ = evaluate_registration(
                    registration, sweeps.cloud, of_kind, progress=step
                )
            found[kind][name] = errors
    return found


def _by_class(
    results: Mapping[str, RegistrationErrors | str], chosen: np.ndarray
) -> dict[str, Any]:
    return {
        name: errors.select(chosen).plain()
        for name, errors in results.items()
        if isinstance(errors, RegistrationErrors) and chosen.any()
    }
