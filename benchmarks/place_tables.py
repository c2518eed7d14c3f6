"""What the tables about place recognition show of benchmarks/results/place_recognition.json."""

from collections.abc import Sequence

from benchmarks.result_table import Cell, Row, Table, WideRow

_SETS = ('town', 'town_far', 'sensor', 'aliased')
_METHODS = {
    'teacher': 'teacher alone',
    'student': 'student alone',
    'shared': 'shared-space ensemble',
    'naive': 'naive ensemble',
    'mason': 'Mason et al. (a database a member)',
    'dropout': 'MC dropout',
    'stun': 'aleatoric student (STUN)',
}
_SCORES = {
    'shared_combined': 'shared space, combined',
    'shared_u': 'shared space, u_EV',
    'naive': 'naive ensemble, u_EV',
    'mason_variance': 'Mason et al., variance',
    'mason_similarity': 'Mason et al., similarity',
    'dropout': 'MC dropout, u_EV',
    'stun': 'aleatoric student, variance',
    'distance': 'distance alone',
}
_MEMBERS = {'triplet': 'from scratch', 'distilled': 'distilled'}
_ARCHITECTURES = {'minkloc3d': 'MinkLoc3D', 'pointnetvlad': 'PointNetVLAD'}


def _exchanged(architecture: str, kind: str) -> WideRow:
    figures = f'interchange.{kind}.{architecture}'
    return WideRow(
        f'{_ARCHITECTURES[architecture]}, {_MEMBERS[kind]}',
        tuple(
            Cell('{:.1f} %', (f'{figures}.{name}',), 100)
            for name in ('diagonal_r1', 'off_diagonal_r1', 'chance_r1')
        ),
    )


def _trained_for(batches: int) -> WideRow:
    figures = f'epochs.minkloc3d.{batches}'
    recalls = ('r1', 'student_r1', 'off_diagonal_r1')
    return WideRow(
        f'{batches}',
        (
            *(Cell('{:.1f} %', (f'{figures}.{name}',), 100) for name in recalls),
            *(Cell('{:.2f}', (f'{figures}.{name}',)) for name in ('u_auroc', 'distance_auroc')),
        ),
    )


def _on_every_set(what: str, key: str, shown: str, figures: Sequence[str], times: float) -> WideRow:
    """Return a row with a cell for each test set; `key` has a star for its name."""
    return WideRow(
        what,
        tuple(
            Cell(shown, tuple(f'{key.replace("*", name)}.{one}' for one in figures), times)
            for name in _SETS
        ),
    )


def _recalled(method: str, what: str) -> WideRow:
    shown = '{:.1f} / {:.1f} / {:.1f}'
    figures: tuple[str, ...] = ('r1', 'r5', 'r10')
    if method != 'teacher':
        shown += ' ({:+.1f} / {:+.1f} / {:+.1f})'
        figures += tuple(f'{one}_above_teacher' for one in figures)
    return _on_every_set(what, f'recall.*.{method}', shown, figures, 100)


def _euclidean(method: str, what: str) -> WideRow:
    return _on_every_set(what, f'recall_euclidean.*.{method}', '{:.1f}', ('r1',), 100)


def _found(score: str, what: str) -> WideRow:
    return _on_every_set(
        what, f'failure.*.{score}', '{:.3f} / {:.3f} / {:.2f}', ('auroc', 'aurc', 'fpr95'), 1
    )


def _found_more(score: str, what: str) -> WideRow:
    figures = ('aupr_in', 'aupr_out', 'recall_at_p99')
    return _on_every_set(what, f'failure.*.{score}', '{:.3f} / {:.3f} / {:.2f}', figures, 1)


def _found_unknown(score: str, what: str) -> WideRow:
    figures = ('auroc', 'auroc_low', 'auroc_high')
    shown = '{:.3f} ({:.3f} to {:.3f})'
    return _on_every_set(what, f'failure_open_set.*.{score}', shown, figures, 1)


def _searched(size: int) -> WideRow:
    engines = ('exact', 'compact', 'mason', 'faiss_hnsw')
    return WideRow(
        f'{size:,}',
        tuple(Cell('{:.2f}', (f'query_ms_by_index.{size}.{one}',)) for one in engines),
    )


def _elsewhere(name: str) -> WideRow:
    figures = f'guarantee.elsewhere.{name}'
    rates = f'{figures}.target_05'
    return WideRow(
        name,
        (
            Cell('{:.0f} of {:.0f}', (f'{figures}.runs_with_alarm', f'{figures}.runs')),
            Cell('{:.1f} %', (f'{figures}.share_under_alarm',), 100),
            Cell('{:.1f} %', (f'{rates}.ignoring_the_alarm',), 100),
            Cell('{:.1f} %', (f'{rates}.minding_the_alarm',), 100),
            Cell('{:.1f} %', (f'{rates}.accepted_right',), 100),
        ),
    )


PLACE_TABLES = {
    'place_recognition': Table('place_recognition', (
        *(
            Row(f'False matches, {share} % promised', '{:.1f} % ({:.1f} to {:.1f})',
                tuple(f'guarantee.target_{share:02d}.{key}' for key in ('observed', 'low', 'high')),
                f'≤ {share} %', 100)
            for share in (1, 5)
        ),
        *(
            Row(f'First match right, set {name}: shared space / teacher', '{:.1f} / {:.1f} %',
                (f'recall.{name}.shared.r1', f'recall.{name}.teacher.r1'), '', 100)
            for name in _SETS
        ),
        *(
            Row(f'Wrong matches found, AUROC, set {name}: combined / distance / u_EV',
                '{:.2f} / {:.2f} / {:.2f}',
                tuple(f'failure.{name}.{score}.auroc'
                      for score in ('shared_combined', 'distance', 'shared_u')))
            for name in _SETS
        ),
        Row('MinkLoc3D embedding / five members', '{:.0f} / {:.0f} ms',
            ('embed_ms', 'five_members_ms'), '≤ 80 / 160 ms'),
        Row('Query among 18,000 / 1,000,000: exact, and with eight bits first',
            '{:.2f} / {:.1f} ms, {:.2f} / {:.1f} ms',
            tuple(f'query_ms_by_index.{size}.{engine}' for engine in ('exact', 'compact')
                  for size in (18000, 1000000))),
        Row('Real out-and-back drive: returns recognised first', '{:.0f} %',
            ('real.out_and_back.recall_1_of_revisits',), '', 100),
        Row('— answers accepted / of them wrong', '{:.0f} / {:.0f}',
            ('real.out_and_back.accepted', 'real.out_and_back.accepted_wrong')),
        *(
            Row(f'{what} tells a removed quarter / half / sixteen beams from clean sweeps, AUROC',
                '{:.2f} / {:.2f} / {:.2f}',
                tuple(f'real.changed_inputs.{view}.{figure}'
                      for view in ('sector_90', 'sector_180', 'sixteen_beams')), '> 0.5')
            for what, figure in (('Probability of a wrong match', 'auroc_of_wrong_probability'),
                                 ('— u_EV alone', 'auroc'))
        ),
        Row('Gate in the aliased district: registrations without / with', '{:.0f} / {:.0f}',
            ('gate.off.registered', 'gate.on.registered')),
        Row('— of them of different places', '{:.0f} / {:.0f}',
            ('gate.off.false_registered', 'gate.on.false_registered')),
        Row('— true loops', '{:.0f} / {:.0f}', ('gate.off.true', 'gate.on.true')),
        Row('— false loops', '{:.0f} / {:.0f}', ('gate.off.false', 'gate.on.false'), '0'),
        Row('— ATE', '{:.2f} / {:.2f} m', ('gate.off.ate_m', 'gate.on.ate_m')),
    )),
    'place_interchange': Table(
        'place_recognition',
        tuple(_exchanged(one, kind) for one in _ARCHITECTURES for kind in _MEMBERS),
        ('five members', 'searched in their own map', "in another member's", 'by chance'),
        'interchange',
    ),
    'place_epochs': Table(
        'place_recognition',
        tuple(_trained_for(batches) for batches in (800, 1600)),
        ('three students of MinkLoc3D, batches', 'ensemble, R@1', 'a student', "in another's map",
         'AUROC of u_EV', 'of distance'),
        'epochs',
    ),
    'place_recall': Table(
        'place_recognition',
        tuple(_recalled(*one) for one in _METHODS.items()),
        ('recall at 1 / 5 / 10, %', *_SETS),
        'recall',
    ),
    'place_failure': Table(
        'place_recognition',
        tuple(_found(*one) for one in _SCORES.items()),
        ('AUROC / AURC / FPR at 95 % TPR', *_SETS),
        'failure',
    ),
    'place_euclidean': Table(
        'place_recognition',
        tuple(_euclidean(*one) for one in _METHODS.items()),
        ('recall at 1 by Euclidean distance, %', *_SETS),
        'recall',
    ),
    'place_pointnetvlad': Table(
        'place_recognition',
        tuple(
            WideRow(
                _METHODS[method],
                (
                    Cell('{:.1f} / {:.1f} / {:.1f}', tuple(
                        f'recall_of_others.pointnetvlad.town.{method}.{one}'
                        for one in ('r1', 'r5', 'r10')), 100),
                ),
            )
            for method in ('student', 'shared', 'naive', 'mason')
        ),
        ('PointNetVLAD, recall at 1 / 5 / 10, %', 'town'),
        'interchange',
    ),
    'place_failure_more': Table(
        'place_recognition',
        tuple(_found_more(*one) for one in _SCORES.items()),
        ('AuPR-in / AuPR-out / recall at 99 % precision', *_SETS),
        'failure',
    ),
    'place_open_set': Table(
        'place_recognition',
        (*(_found_unknown(*one) for one in _SCORES.items()),
         _found_unknown('shared_ratio', 'shared space, ratio to the second place alone'),
         _found_unknown('naive_distance', 'naive ensemble, distance')),
        ('AUROC, three in ten places unknown', *_SETS),
        'failure',
    ),
    'place_probability': Table(
        'place_recognition',
        tuple(
            _on_every_set(what, f'probability.*{suffix}', '{:.2f} / {:.2f}', ('ece', 'brier'), 1)
            for what, suffix in (
                ('all places known', ''), ('three in ten places unknown', '_open_set')
            )
        ),
        ('error of the probability (ECE / Brier)', *_SETS),
        'failure',
    ),
    'place_elsewhere': Table(
        'place_recognition',
        tuple(_elsewhere(name) for name in _SETS),
        ('5 % promised, set', 'runs with alarm', 'queries under alarm', 'wrong ones accepted',
         'minding the alarm', 'right ones accepted'),
        'guarantee',
    ),
    'place_queries': Table(
        'place_recognition',
        tuple(_searched(size) for size in (18_000, 100_000, 1_000_000)),
        ('a query of 256 numbers, ms; places', 'exact (the node)', 'compact', "five (Mason's)",
         'faiss HNSW'),
        'cost',
    ),
}  # fmt: skip
