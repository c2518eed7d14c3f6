"""Measure place recognition beside competing ensembles: benchmarks/results/place_recognition.json.

    python -m benchmarks.place_recognition                     everything (hours on two cores)
    python -m benchmarks.place_recognition --only cost real    some sections; the others stay
    python -m benchmarks.place_recognition --quick             a town of three short runs a set
    python -m benchmarks.place_recognition --list              the sections and what they measure
    python -m benchmarks.place_recognition --work build/places keep runs, embeddings, pictures

PLACE_WEIGHTS names the folder of all trained networks, <architecture>/<role>: minkloc3d and
pointnetvlad; teacher, students, naive, dropout and stun; for the section epochs also
minkloc3d/epochs/<batches>/students. PLACE_ENSEMBLE and PLACE_CALIBRATION name
what real and gate use; without, what ships. Runs and embeddings in the work folder are not made
again: they may come from a machine with a GPU. Exits with 1 when a section failed or a required
figure is missing.
"""

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from benchmarks.command import Benchmark, Section, run_benchmark

_SETS = ('town', 'town_far', 'sensor', 'aliased')
_METHODS = ('teacher', 'student', 'shared', 'naive', 'mason', 'dropout', 'stun')
_SCORES = (
    'shared_combined', 'shared_u', 'naive', 'mason_variance', 'mason_similarity', 'dropout', 'stun',
    'distance',
)  # fmt: skip
REQUIRED = (
    *(
        f'interchange.{kind}.{architecture}.{figure}'
        for kind in ('triplet', 'distilled')
        for architecture in ('minkloc3d', 'pointnetvlad')
        for figure in ('diagonal_r1', 'off_diagonal_r1', 'chance_r1')
    ),
    *(
        f'recall.{name}.{method}.{figure}'
        for name in _SETS
        for method in _METHODS
        for figure in ('r1', 'r5', 'r10')
    ),
    *(
        f'failure.{name}.{score}.{figure}'
        for name in _SETS
        for score in _SCORES
        for figure in ('auroc', 'aurc', 'fpr95', 'recall_at_p99')
    ),
    *(
        f'guarantee.{target}.{figure}'
        for target in ('target_01', 'target_05')
        for figure in ('observed', 'low', 'high')
    ),
    'embed_ms',
    'five_members_ms',
    'query_ms.18000',
    'query_ms.100000',
    'query_ms.1000000',
    'gate.*',
)


def sections(quick: bool = False) -> dict[str, tuple[str, Section]]:
    """Return every section by name: what it measures, and the function that does."""
    # Imported here: --help and --list need none of it.
    from benchmarks import place_gate, place_methods, place_real, place_speed

    sizes = place_speed.SIZES[:1] if quick else place_speed.SIZES
    return {
        'interchange': (
            'recall between members: trained by triplets, and distilled',
            partial(place_methods.exchanged, quick=quick),
        ),
        'recall': (
            'recall of all methods on four test sets',
            partial(place_methods.recalls, quick=quick),
        ),
        'failure': (
            'how well doubts find wrong matches, on the same sets',
            partial(place_methods.failures, quick=quick),
        ),
        'epochs': (
            'recall and doubt of students trained for fewer and for more batches',
            partial(place_methods.epochs, quick=quick),
        ),
        'guarantee': (
            'promised rates on resplits of runs, and the drift alarm elsewhere',
            partial(place_methods.guarantee, quick=quick),
        ),
        'cost': ('times of embedding and searching', partial(place_speed.evaluate, sizes=sizes)),
        'real': (
            'real sweeps: matches and uncertainties through the node, changed inputs',
            partial(place_real.evaluate, step=30 if quick else 3),
        ),
        'gate': (
            'loop closure in the aliased district, with the gate on and off',
            partial(place_gate.evaluate, length_m=600.0 if quick else 1500.0),
        ),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    benchmark = Benchmark('place_recognition', __doc__ or '', sections, REQUIRED, _placed)
    return run_benchmark(benchmark, argv)


def _placed(figures: dict[str, Any], section: str, new: dict[str, Any]) -> Mapping[str, Any]:
    """Put a section's figures at the top, by their names."""
    del section
    return {**figures, **new}


if __name__ == '__main__':
    sys.exit(main())
