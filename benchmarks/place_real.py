"""Place recognition on real sweeps, none of which the shipped ensemble was trained or chosen on."""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bags.drives import open_drive
from bags.records import LidarScan
from benchmarks.loop_pairs import TRUE_PAIR, clouds, kitti_00
from benchmarks.place_speed import median_ms
from benchmarks.recordings import folder, karlsruhe_out_and_back
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.evaluation.sweep_views import without_sector
from uncertain_place_recognition.evaluation.failure import auroc
from uncertain_place_recognition.evaluation.figures import figure
from uncertain_place_recognition.opened import open_recognizer
from uncertain_place_recognition.place_recognizer import PlaceRecognizer, PlaceRecognizerConfig
from uncertain_place_recognition.uncertainty import total_uncertainty

if TYPE_CHECKING:
    from benchmarks.nodes.place_replay import Answers

_MOUNT = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 1.73])
_SAME_PLACE_M = 25.0
_EVERY_SCAN = {'asked__distance': 0.1, 'places__distance': 0.1, 'recognizer__delay': 0}


def evaluate(work: Path, step: int = 3) -> dict[str, Any]:
    """Measure all of this; `step` takes every n-th Karlsruhe sweep for changed inputs."""
    figures = {
        'kitti_00': true_pair(),
        'kitti_360_one_place': one_place(),
        'changed_inputs': changed_inputs(work, step),
    }
    # Processes of their own: the first odometry of a process decides on KISS-ICP's threads.
    for name, section in (
        ('out_and_back', _out_and_back),
        ('kitti_00', _kitti_00),
        ('kitti_360_one_place', _kitti_360),
    ):
        with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
            found = pool.submit(section, work).result()
        figures[name] = {**figures.get(name, {}), **found}
    return {'real': figures}


def true_pair() -> dict[str, Any]:
    """Ask where KITTI 00's scan 4501 is, in a map of the other scans, in any heading."""
    scans, T_world_base = kitti_00()
    recognizer = recognizer_of_this()
    for number, cloud in sorted(scans.items()):
        if number != TRUE_PAIR[1]:
            recognizer.add(
                _in_base(cloud), T_world_base[number], stamp_ns=number * 10**8, id=number
            )
    recognizer = _all_searchable(recognizer)
    query, right, answers = _in_base(scans[TRUE_PAIR[1]]), 0, []
    for yaw in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False):
        answer = recognizer.locate(query.transformed(se3.rotation_z(float(yaw))))
        assert answer.best is not None
        right += answer.best.place_id == TRUE_PAIR[0]
        answers.append(answer)
    first = answers[0]
    assert first.best is not None
    return {
        'places': len(recognizer),
        'headings': len(answers),
        'right': right,
        'match_as_driven': first.best.place_id,
        'similarity_as_driven': first.best.similarity,
        'uncertainty_as_driven': first.uncertainty_normalised,
        'accepted_as_driven': first.best.accepted,
        'embed_ms': median_ms(lambda: recognizer.embed(query), 5),
    }


def one_place() -> dict[str, Any]:
    """Compare KITTI-360's 24 frames: they span 23.5 m and are one place, not a test of recall."""
    recognizer = recognizer_of_this()
    members = np.array(
        [recognizer.embed(_in_base(cloud)) for cloud in clouds(folder() / 'data' / 'kitti_360')]
    )
    mean = members.mean(1)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    similarity = (mean @ mean.T)[np.triu_indices(len(mean), 1)]
    uncertainty = total_uncertainty(members)
    return {
        'frames': len(members),
        'least_similarity': float(similarity.min()),
        'mean_similarity': float(similarity.mean()),
        'mean_uncertainty': float(uncertainty.mean()),
    }


def changed_inputs(work: Path, step: int) -> dict[str, Any]:
    """Return how well doubt tells changed sweeps from clean ones (Karlsruhe, AUROC).

    Uncertainty is u_EV; the probability that the match is wrong is of sweeps asked for in a map of
    others, clean ones, between them.
    """
    drive = open_drive(karlsruhe_out_and_back(work).parents[1])
    truth = open_drive(karlsruhe_out_and_back(work)).truth()
    assert truth is not None
    scans = [one for one in drive.records(kinds=[LidarScan]) if isinstance(one, LidarScan)][::step]
    recognizer = recognizer_of_this()
    for number, scan in enumerate(scans[1::2]):
        T_world_base = truth.at(scan.stamp_ns)
        assert T_world_base is not None
        recognizer.add(_in_base(scan.cloud), T_world_base, stamp_ns=scan.stamp_ns, id=number)
    recognizer = _all_searchable(recognizer)
    asked = [scan.cloud for scan in scans[::2]]
    rng = np.random.default_rng(0)
    views: dict[str, Callable[[PointCloud], PointCloud]] = {
        'clean': lambda cloud: cloud,
        'sector_90': lambda cloud: without_sector(cloud, float(rng.uniform(-3.1, 3.1)), np.pi / 2),
        'sector_180': lambda cloud: without_sector(cloud, float(rng.uniform(-3.1, 3.1)), np.pi),
        'sixteen_beams': _sixteen_beams,
    }
    found = {name: _doubts(recognizer, asked, view) for name, view in views.items()}
    clean = found.pop('clean')
    figures: dict[str, Any] = {
        'sweeps': len(clean),
        'places': len(recognizer),
        'clean_uncertainty': float(np.median(clean[:, 0])),
        'clean_wrong_probability': float(np.median(clean[:, 1])),
    }
    for name, values in found.items():
        changed = np.r_[np.zeros(len(clean), bool), np.ones(len(values), bool)]
        uncertainty, wrong = np.r_[clean, values].T
        figures[name] = {
            'uncertainty': float(np.median(values[:, 0])),
            'auroc': auroc(uncertainty, changed),
            'wrong_probability': float(np.median(values[:, 1])),
            'auroc_of_wrong_probability': auroc(wrong, changed),
            'too_few_points': len(asked) - len(values),
        }
    return figures


def recognizer_of_this() -> PlaceRecognizer:
    """Return a recognizer with $PLACE_ENSEMBLE, or the ensemble that ships."""
    return open_recognizer(
        os.environ.get('PLACE_ENSEMBLE', ''), os.environ.get('PLACE_CALIBRATION', '')
    )


def _out_and_back(work: Path) -> dict[str, Any]:
    """Drive the out-and-back recording through odometry and place recognition."""
    drive = open_drive(karlsruhe_out_and_back(work))
    truth = drive.truth()
    assert truth is not None
    answers = _through_the_node(drive, odometry={'max_range': 80.0, 'min_range': 3.0})
    here, there = (_positions(truth, one) for one in (answers.stamps_ns, answers.found_ns))
    # A place is known where the vehicle was before, except for the last ones (they wait).
    order = answers.places_ns.tolist()
    known = np.array(
        [
            _was_here(truth, order, stamp, where)
            for stamp, where in zip(answers.stamps_ns.tolist(), here, strict=True)
        ]
    )
    right = np.linalg.norm(here - there, axis=1) <= _SAME_PLACE_M
    uncertainty, accepted = answers.uncertainty, answers.accepted
    _draw(here, there, right, known, uncertainty, work / 'pictures' / 'out_and_back.png')
    both = right.any() and not right.all()
    return {
        'answers': len(right),
        'revisits': int(known.sum()),
        'recall_1_of_revisits': float(right[known].mean()) if known.any() else None,
        'accepted': int(accepted.sum()),
        'accepted_wrong': int((accepted & ~right).sum()),
        'auroc_of_uncertainty': auroc(uncertainty, ~right) if both else None,
    }


def _kitti_00(work: Path) -> dict[str, Any]:
    """Let KITTI 00's scans through the node, with their true poses as odometry."""
    drive = open_drive(folder() / 'data' / 'kitti_odometry', sequence='00')
    truth = drive.truth()
    assert truth is not None
    poses = dict(zip(truth.stamps_ns.tolist(), truth.T_world_body, strict=True))
    answers = _through_the_node(drive, poses, **_EVERY_SCAN)
    here, there = (_positions(truth, one) for one in (answers.stamps_ns, answers.found_ns))
    right = np.linalg.norm(here - there, axis=1) <= _SAME_PLACE_M
    known = np.array(
        [
            (np.linalg.norm(_positions(truth, places) - where, axis=1) <= _SAME_PLACE_M).any()
            for where, places in zip(
                here,
                [answers.places_ns[answers.places_ns < stamp] for stamp in answers.stamps_ns],
                strict=True,
            )
        ]
    )
    title = 'KITTI 00: scans in order, each asked in the map of those before it'
    _draw_answers(answers, right, known, title, work / 'pictures' / 'kitti_00.png')
    query = truth.stamps_ns[TRUE_PAIR[1]]
    last = np.flatnonzero(answers.stamps_ns == query)
    return {
        'through_the_node': len(right),
        'through_the_node_known': int(known.sum()),
        'through_the_node_right': int((right & known).sum()),
        'loop_found_by_the_node': bool(right[last].all()) if len(last) else None,
    }


def _kitti_360(work: Path) -> dict[str, Any]:
    """Drive KITTI-360's frames, which are one place, through odometry and the node."""
    drive = open_drive(folder() / 'data' / 'kitti_360')
    answers = _through_the_node(drive, **_EVERY_SCAN)
    right = np.ones(len(answers.stamps_ns), bool)  # one place: whatever is found is right
    title = 'KITTI-360: frames within 23.5 m are one place'
    _draw_answers(answers, right, right, title, work / 'pictures' / 'kitti_360.png')
    return {
        'through_the_node': len(right),
        'least_similarity_by_the_node': float(answers.similarity.min()),
        'accepted_by_the_node': int(answers.accepted.sum()),
    }


def _through_the_node(drive: Any, poses: Any = None, **settings: Any) -> 'Answers':
    from benchmarks.nodes.place_replay import answers_of

    settings['weights'] = os.environ.get('PLACE_ENSEMBLE', '')
    settings['calibration'] = os.environ.get('PLACE_CALIBRATION', '')
    return answers_of(drive, poses, **settings)


def _positions(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.reshape([_position(truth, stamp) for stamp in stamps_ns.tolist()], (-1, 2))


def _position(truth: Trajectory, stamp_ns: int) -> NDArray[np.float64]:
    T_world_base = truth.at(stamp_ns)
    assert T_world_base is not None
    return T_world_base[:2, 3]


def _was_here(truth: Trajectory, places: list[int], stamp: int, where: NDArray[np.float64]) -> bool:
    # The newest places wait.
    before = [one for one in places if one < stamp][: -PlaceRecognizerConfig().delay]
    at = np.array([_position(truth, one) for one in before]).reshape(-1, 2)
    return bool((np.linalg.norm(at - where, axis=1) <= _SAME_PLACE_M).any())


def _draw(
    here: NDArray[np.float64],
    there: NDArray[np.float64],
    right: NDArray[np.bool_],
    known: NDArray[np.bool_],
    uncertainty: NDArray[np.float64],
    path: Path,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(here, axis=0), axis=1))]
    # There and back on one road: a place is where it lies along the road.
    along = np.linalg.svd(here - here.mean(0), full_matrices=False)[2][0]
    colours = _colours(right, known)
    with figure(path, (13.0, 5.0)) as canvas:
        places, doubts = canvas.subplots(1, 2)
        places.plot(travelled, here @ along, color='#222222', lw=1.2, label='vehicle')
        places.scatter(travelled, there @ along, c=colours, s=12, zorder=3)
        places.set_title('Best match of every scan')
        places.set_ylabel('position along the road [m]')
        doubts.scatter(travelled, uncertainty, c=colours, s=12)
        doubts.set_title('Uncertainty u')
        _name_colours(places)
        for ax in (places, doubts):
            ax.set_xlabel('travelled [m]')


def _draw_answers(
    answers: 'Answers',
    right: NDArray[np.bool_],
    known: NDArray[np.bool_],
    title: str,
    path: Path,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    colours = _colours(right, known)
    number = np.arange(len(right))
    with figure(path, (13.0, 4.2)) as canvas:
        for ax, values, name in zip(
            canvas.subplots(1, 3),
            (answers.similarity, answers.uncertainty, answers.wrong_probability),
            ('Similarity of the best match', 'Uncertainty u', 'Probability that it is wrong'),
            strict=True,
        ):
            ax.scatter(number, values, c=colours, s=22)
            ax.set_title(name)
            ax.set_xlabel('scan that was asked')
        _name_colours(canvas.axes[0])
        canvas.suptitle(title)


def _colours(right: NDArray[np.bool_], known: NDArray[np.bool_]) -> NDArray[np.str_]:
    return np.where(right, '#009E73', np.where(known, '#D55E00', '#BBBBBB'))


def _name_colours(ax: Any) -> None:
    for name, colour in (
        ('right', '#009E73'), ('wrong', '#D55E00'), ('a place it does not know', '#BBBBBB'),
    ):  # fmt: skip
        ax.scatter([], [], c=colour, s=12, label=name)
    ax.legend(fontsize=8)


def _doubts(
    recognizer: PlaceRecognizer, sweeps: list[PointCloud], view: Callable[[PointCloud], PointCloud]
) -> NDArray[np.float64]:
    """Return u_EV and the probability that the match is wrong [N x 2] of sweeps as viewed."""
    found = []
    for cloud in sweeps:
        try:
            answer = recognizer.locate(_in_base(view(cloud)))
        except DataError:
            continue  # too little is left above the ground; counted by the caller
        assert answer.best is not None and answer.best.false_match_probability is not None
        found.append((answer.uncertainty_normalised, answer.best.false_match_probability))
    return np.array(found)


def _sixteen_beams(cloud: PointCloud) -> PointCloud:
    """Return what a sensor of 16 beams from -15 to 15 degrees would have of a sweep (LiDAR)."""
    elevation = np.degrees(np.arctan2(cloud.xyz[:, 2], np.linalg.norm(cloud.xyz[:, :2], axis=1)))
    off = np.abs((elevation + 15.0) / 2.0 - np.round((elevation + 15.0) / 2.0))
    return cloud.select((np.abs(elevation) <= 15.5) & (off < 0.1))


def _all_searchable(recognizer: PlaceRecognizer) -> PlaceRecognizer:
    """Return a recognizer that answers with all places: as after saving and loading a map."""
    import tempfile

    with tempfile.TemporaryDirectory() as temporary:
        recognizer.load(recognizer.save(Path(temporary) / 'map'))
    return recognizer


def _in_base(cloud: PointCloud) -> PointCloud:
    return cloud.transformed(_MOUNT)
