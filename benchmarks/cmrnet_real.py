"""CMRNet on real frames of KITTI-360: one street, before and after fine-tuning on its beginning."""

import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.image import imsave
from tqdm import tqdm

from bags.drives import open_drive
from bags.records import CameraImage, Drive, LidarScan
from benchmarks.cmrnet_sets import predictors
from benchmarks.recordings import folder
from cmrnet_ekf.calibration import calibration
from cmrnet_ekf.camera_localizer import framing_of, imager_of
from cmrnet_ekf.evaluation.answers import Answers, ask
from cmrnet_ekf.localization_errors import pose_errors, summary
from cmrnet_ekf.mapping.build import drive_sweeps
from cmrnet_ekf.mapping.local_map import LocalMap, near_origin
from cmrnet_ekf.mapping.map_builder import MapBuilder
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.tile_folder import TileFolder
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.overlay import overlay
from cmrnet_ekf.pose_sampling import STAGES, T_OPTICAL_BODY
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.sample_maker import SamplesConfig, make_samples
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.trainer import Trainer
from cmrnet_ekf.training.variants import NETWORKS, variant
from lcd_common import se3
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.lidar_odometry import LidarOdometry
from lcd_loop_closure.odometry_config import OdometryConfig

_MAPPED = 18  # frames 3000 to 3017; the six after them are judged
_DRAWS, _DRAWS_JUDGED = 40, 50
_STEPS = 400
_SHOWN = 3  # of the judged frames: the overlay


def evaluate(work: Path, quick: bool = False) -> dict[str, Any]:
    """Localize frames 3018 to 3023 in the map of sweeps 3000 to 3017, from random starts."""
    drive = open_drive(folder() / 'data' / 'kitti_360')
    poses = reference(drive)
    mapped, judged = poses.stamps_ns[:_MAPPED], poses.stamps_ns[_MAPPED:]
    found = predictors(others=False)
    der = found['der'].networks[0]
    kept = work / 'kitti_360'
    local_map = LocalMap(build(kept / 'map', drive, poses, mapped))
    every = SamplesConfig(spacing=0.0, draws=4 if quick else _DRAWS)
    learnt = samples(kept / f'learnt_{every.draws}', drive, poses, local_map, der, every, mapped)
    many = SamplesConfig(spacing=0.0, draws=4 if quick else _DRAWS_JUDGED, seed=1)
    test = samples(kept / f'judged_{many.draws}', drive, poses, local_map, der, many, judged)
    guesses = np.asarray(test.guesses)
    rough = summary(*pose_errors(np.broadcast_to(np.eye(4), guesses.shape), guesses))
    tuned = fine_tuned(kept / 'tuned', der, learnt, 5 if quick else _STEPS)
    answers = {f'{role}_before': ask(one, [test]) for role, one in found.items()}
    answers['der_after'] = ask(tuned, [test])
    for name, predictor in (('before', found['der']), ('after', tuned)):
        path = work / 'pictures' / 'cmrnet' / f'kitti_360_{name}.png'
        show(path, drive, poses, local_map, predictor, judged)
    return {
        'scene': 'one street of 23.5 m: the judged frames follow those that were learnt from',
        'poses': "this suite's LiDAR odometry over the sweeps themselves, not the data set's",
        'map_frames': len(mapped),
        'judged_frames': len(judged),
        'samples': len(test),
        'fine_tuning_steps': 5 if quick else _STEPS,
        'rough': asdict(rough),
        **{name: _figures(one) for name, one in answers.items()},
    }


def reference(drive: Drive) -> Trajectory:
    """Return poses of base_link by registering the sweeps with each other; the first is 0."""
    T_base_lidar = next(m.T_parent_child for m in drive.mountings if m.child == 'lidar')
    odometry = LidarOdometry(OdometryConfig(max_range=80.0, min_range=3.0))
    stamps, poses = [], []
    for scan in drive.records(kinds=[LidarScan]):
        assert isinstance(scan, LidarScan)
        estimate = odometry.register(scan.cloud, scan.stamp_ns)
        stamps.append(scan.stamp_ns)
        poses.append(T_base_lidar @ estimate.T_odom_lidar @ se3.inverse(T_base_lidar))
    return Trajectory(np.array(stamps, np.int64), np.array(poses))


def build(path: Path, drive: Drive, poses: Trajectory, stamps: Any) -> Path:
    """Map the sweeps between the first and the last of some stamps, unless that is done."""
    if not (path / 'done').is_file():
        settings = MapConfig()
        builder = MapBuilder(TileFolder.create(path, settings), settings)
        for sweep in drive_sweeps(drive, poses, int(stamps[0]), int(stamps[-1])):
            builder.add(sweep.cloud, sweep.T_map_base, sweep.T_base_sensor)
        builder.finish()
        (path / 'done').touch()
    return path


def samples(
    out: Path,
    drive: Drive,
    poses: Trajectory,
    local_map: LocalMap,
    network: Cmrnet,
    settings: SamplesConfig,
    stamps: Any,
) -> SampleSet:
    """Return samples of the images between two stamps, made when they are not there."""
    if not (out / 'facts.json').is_file():
        with tqdm(unit='frame', desc=out.name) as bar:
            make_samples(
                out, drive, poses, local_map, network.settings, STAGES[0], settings, bar.update,
                (int(stamps[0]), int(stamps[-1])),
            )  # fmt: skip
    return SampleSet(out)


def fine_tuned(out: Path, network: Cmrnet, learnt: SampleSet, steps: int) -> Predictor:
    """Return a copy of a network that went on learning; nothing is chosen by what is judged."""
    shutil.rmtree(out, ignore_errors=True)  # of other weights, perhaps
    copy = Cmrnet(network.settings)
    copy.load_state_dict(network.state_dict())
    settings = replace(NETWORKS['compact'][1], steps=steps, learning_rate=1e-4)
    loss = variant('der', 'compact').loss
    # The second of the thesis's two steps: this is the end of a training.
    loss = replace(loss, evidence_first=loss.evidence_second)
    trainer = Trainer(copy, [learnt], out, settings, loss)
    for _ in tqdm(trainer.run(), 'fine-tuning', steps, initial=trainer.step):
        pass
    return Predictor([copy])


def show(
    path: Path,
    drive: Drive,
    poses: Trajectory,
    local_map: LocalMap,
    predictor: Predictor,
    judged: Any,
) -> None:
    """Draw the map over one judged image: from a wrong start, as localized, and as registered."""
    assert drive.camera is not None
    stamp_ns = int(judged[min(_SHOWN, len(judged) - 1)])
    T_map_base = poses.at(stamp_ns)
    record = next(iter(drive.records(stamp_ns, stamp_ns, [CameraImage])))
    assert T_map_base is not None and isinstance(record, CameraImage)
    T_base_body = (
        next(m.T_parent_child for m in drive.mountings if m.child == drive.camera.frame_id)
        @ T_OPTICAL_BODY
    )
    framing = framing_of(drive.camera, predictor.settings)
    imager = imager_of(framing.camera, predictor.settings)
    points, origin = local_map.around(T_map_base)
    T_true = near_origin(T_map_base, origin) @ T_base_body
    T_guess = T_true @ STAGES[0].draw(np.random.default_rng(2), 1)[0]

    def lidar(T_map_body: se3.Array) -> Any:
        return imager.image(points, T_OPTICAL_BODY @ se3.inverse(T_map_body))

    framed = framing.image(record.pixels)
    image = torch.from_numpy(framed).permute(2, 0, 1)[None]
    T_found = T_guess @ predictor.belief(image, lidar(T_guess)[None]).transforms[0]
    rows = [overlay(framed, lidar(T).numpy()) for T in (T_guess, T_found, T_true)]
    path.parent.mkdir(parents=True, exist_ok=True)
    imsave(path, np.concatenate(rows))


def _figures(one: Answers) -> dict[str, Any]:
    figures: dict[str, Any] = asdict(one.summary())
    if one.knows:
        figures['calibration'] = {
            axis: curve.mean_error for axis, curve in calibration(one.belief, one.target).items()
        }
    return figures
