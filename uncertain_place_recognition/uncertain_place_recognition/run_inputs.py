"""Read the runs that a command names: submaps, which are embedded, or embeddings of earlier."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lcd_common.errors import ConfigError, DataError
from uncertain_place_recognition.embedded_run import EmbeddedRun, is_embedded
from uncertain_place_recognition.evaluation.pairs import STUN_VARIANCE
from uncertain_place_recognition.runs import SubmapRun

if TYPE_CHECKING:
    from uncertain_place_recognition.ensemble import EmbeddingEnsemble

_BATCH = 16
_METRIC = 'metric'  # what no run says: submaps of live sweeps
_NO_LOOKS = ('fewest',)  # says when there is no submap, not how one looks
ROLES = ('teacher', 'students', 'naive', 'dropout', 'stun')


def load_ensembles(named: Sequence[str], device: str) -> 'dict[str, EmbeddingEnsemble]':
    """Read ensembles that are given as ROLE=PATH; a path alone is the students.

    Raises:
        ConfigError: a role is unknown or comes twice.
        DataError: there are no such weights.
    """
    # Torch is imported where networks are needed: embeddings of earlier need none.
    from uncertain_place_recognition.ensemble import EmbeddingEnsemble

    found: dict[str, EmbeddingEnsemble] = {}
    for text in named:
        role, equals, path = text.partition('=')
        if not equals:
            role, path = 'students', text
        if role not in ROLES or role in found:
            reason = 'comes twice' if role in found else 'is unknown'
            raise ConfigError(f'the role {role!r} {reason}; roles are {", ".join(ROLES)}')
        if not Path(path).exists():
            raise DataError(f'{path} does not exist; name a file or folder of weights')
        found[role] = EmbeddingEnsemble.load(Path(path), device)
    return found


def load_embedded(
    paths: Sequence[Path],
    ensembles: 'Mapping[str, EmbeddingEnsemble]',
    keep: Path | None = None,
    quiet: bool = False,
) -> list[EmbeddedRun]:
    """Read runs, files or folders of them, and embed those that are submaps.

    Args:
        paths: .npz files of `SubmapRun` or `EmbeddedRun`, and folders of such.
        ensembles: by role.
        keep: folder for the embeddings, to be read by a later call.
        quiet: show no progress.

    Raises:
        DataError: a file is no run, or submaps come without an ensemble.
    """
    files: list[Path] = []
    for path in paths:
        files += sorted(path.glob('*.npz')) if path.is_dir() else [path]
    if not files:
        raise DataError(f'no runs (*.npz) in {", ".join(map(str, paths))}; make_submap_runs them')
    runs = []
    for file in tqdm(files, 'embedding', unit='run', disable=quiet or not ensembles):
        if is_embedded(file):
            runs.append(EmbeddedRun.load(file))
            continue
        submaps = SubmapRun.load(file)
        if not ensembles:
            raise DataError(f'{file} holds submaps; name the ensemble that embeds them')
        runs.append(embed_submaps(submaps, ensembles))
        if keep is not None:
            runs[-1].save(keep / file.name)
    return runs


def embed_submaps(run: SubmapRun, ensembles: 'Mapping[str, EmbeddingEnsemble]') -> EmbeddedRun:
    """Return the embeddings of a run by all ensembles, and which weights made them.

    Raises:
        DataError: an ensemble was trained on submaps that were made in another way.
    """
    from uncertain_place_recognition.weights_hash import weights_hash

    for role, ensemble in ensembles.items():
        _compare(run, role, ensemble.facts)
    members: dict[str, NDArray[np.float32]] = {}
    for role, ensemble in ensembles.items():
        if role == 'stun':
            found = [ensemble.embed_with_variance(p.astype(np.float32)) for p in run.points]
            means, variances = zip(*found, strict=True)
            if any(one is None for one in variances):
                raise DataError('the ensemble named stun predicts no variance; name it otherwise')
            members[role] = np.stack(means)
            members[STUN_VARIANCE] = np.stack(variances)
            continue
        members[role] = np.concatenate(
            [
                ensemble.embed_many(run.points[begin : begin + _BATCH].astype(np.float32))
                for begin in range(0, len(run), _BATCH)
            ]
        )
    hashes = {role: weights_hash(ensemble.members) for role, ensemble in ensembles.items()}
    facts = {**run.facts, 'weights': hashes}
    return EmbeddedRun(run.name, run.world, run.stamps_ns, run.positions, members, facts)


def _compare(run: SubmapRun, role: str, weights: Mapping[str, Any]) -> None:
    """Raise DataError where a run's submaps are not made as those that weights were trained on."""
    mine, theirs = (facts.get('normalisation', _METRIC) for facts in (run.facts, weights))
    if mine != theirs:
        raise DataError(
            f'run {run.name} has submaps of the normalisation {mine}, the weights of {role} know '
            f'{theirs} ones: embed it by weights that were trained on such'
        )
    told = weights.get('submap')
    if told is None or mine != _METRIC:
        return
    made = run.facts.get('submap') or {'points': run.points.shape[1]}
    differ = [
        f'{name} {made[name]} (weights: {value})'
        for name, value in told.items()
        if name in made and name not in _NO_LOOKS and made[name] != value
    ]
    if differ:
        raise DataError(
            f'run {run.name} has submaps made otherwise than those of {role}: {", ".join(differ)}; '
            'make it anew with make_submap_runs --submap and the settings of the weights'
        )


def weights_of(runs: Sequence[EmbeddedRun], role: str) -> str:
    """Return the hash of the weights that embedded all runs.

    Raises:
        DataError: runs do not tell, or were embedded by different weights.
    """
    found = {str(run.facts.get('weights', {}).get(role, '')) for run in runs}
    if len(found) != 1 or found == {''}:
        raise DataError(
            f'the runs do not tell one and the same ensemble ({role}) that embedded them; embed '
            'their submaps again'
        )
    return found.pop()
