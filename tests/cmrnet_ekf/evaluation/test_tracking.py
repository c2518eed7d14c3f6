"""Track a made-up street by predictors that know the answer."""

import json
from dataclasses import replace

import numpy as np
import pytest
from small_samples import (
    CAMERA,
    SMALL,
    T_BASE_CAMERA,
    BendWithImu,
    StreetWithCamera,
    street_map,
)

from cmrnet_ekf import euler
from cmrnet_ekf.evaluation import track as command
from cmrnet_ekf.evaluation.tracking import THESIS, UNFILTERED, VEHICLE, Track, TrackingConfig, track
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive, record
from cmrnet_ekf.evaluation.tracking_filters import component_covariance
from cmrnet_ekf.evaluation.tracking_study import figures_of, ways
from cmrnet_ekf.networks.checkpoint import save_network
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.pose_belief import PoseBelief
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.thesis_ekf import pose_matrix, pose_vector
from lcd_common import se3
from lcd_common.errors import ConfigError, DataError
from lcd_common.trajectory import Trajectory

EXACT = TrackingConfig(speed_scale=0.0, speed_noise=0.0)


class Oracle(Predictor):
    """Knows where each image was taken, and tells it with errors of its own deviations."""

    def __init__(self, drive: TrackingDrive, scale: np.ndarray, seed: int = 0) -> None:
        super().__init__([Cmrnet(replace(SMALL, head='evidential'))])
        self.drive, self.scale, self.rng = drive, scale, np.random.default_rng(seed)
        self.T_map_looked = np.eye(4)

    def belief(self, image, lidar):
        pixels = image[0].permute(1, 2, 0).numpy()
        number = next(k for k, frame in enumerate(self.drive.frames) if (frame == pixels).all())
        T_body = self.drive.T_map_base[number] @ T_BASE_CAMERA @ T_OPTICAL_BODY
        mean = euler.components(se3.inverse(self.T_map_looked) @ T_body)
        mean = mean - self.rng.normal(size=6) * self.scale
        infinite = np.full((1, 6), np.inf)
        return PoseBelief(mean[None], self.scale[None], infinite, np.square(self.scale)[None])


@pytest.fixture
def oracle(tmp_path, monkeypatch):
    """Make an oracle that is told from where the localizer looks."""

    def make(scale, street=None):
        street = street or StreetWithCamera()
        drive = record(tmp_path / 'frames', street, street.truth(), SMALL)
        predictor = Oracle(drive, np.asarray(scale))
        from cmrnet_ekf.camera_localizer import CameraLocalizer

        ask = CameraLocalizer.locate_framed

        def locate(self, framed, points, T_map_guess, first):
            # Points and guess are told from a tile's corner.
            T = T_map_guess.copy()
            T[:2, 3] += predictor.origin[:2]
            predictor.T_map_looked = T @ T_BASE_CAMERA @ T_OPTICAL_BODY
            return ask(self, framed, points, T_map_guess, first)

        monkeypatch.setattr(CameraLocalizer, 'locate_framed', locate)
        local_map = street_map(tmp_path / 'map')
        around = local_map.around

        def near(T_map_base):
            points, predictor.origin = around(T_map_base)
            return points, predictor.origin

        monkeypatch.setattr(local_map, 'around', near)
        return drive, local_map, predictor

    return make


def test_a_recorded_drive_comes_back_and_moves_as_it_did(tmp_path):
    bend = BendWithImu()
    drive = record(tmp_path, bend, bend.truth(), SMALL)
    assert drive.turned_by == 'imu' and len(drive) == 10 and drive.frames.shape[1:3] == (32, 64)
    np.testing.assert_allclose(drive.turn_rates_radps[1:], 0.2, atol=1e-9)
    np.testing.assert_allclose(drive.speeds_mps[1:], 15.0, rtol=1e-6)
    np.testing.assert_allclose(drive.T_map_base, bend.truth().T_world_body)
    again = record(tmp_path, None, None, SMALL)
    np.testing.assert_array_equal(again.frames, drive.frames)
    assert again.images == tuple(SMALL.images) and again.camera.K[0, 0] == drive.camera.K[0, 0]


def test_exact_motion_from_the_right_start_stays_right(tmp_path):
    bend = BendWithImu()
    drive = record(tmp_path, bend, bend.truth(), SMALL)
    right = replace(EXACT, start_translation=0.0, start_rotation=0.0)
    found = track(drive, None, [], 0, settings=right)
    assert found.metres.max() < 1e-6 and found.radians.max() < 1e-6
    assert not found.diverged and len(found.metres) == 9


def test_wrong_starts_differ_by_seed_and_stay_without_a_camera(tmp_path):
    drive = record(tmp_path, StreetWithCamera(), StreetWithCamera().truth(), SMALL)
    one, other = (track(drive, None, [], seed, settings=EXACT) for seed in (0, 1))
    assert one.radians[0] == pytest.approx(one.radians[-1])
    assert one.metres[0] != other.metres[0]
    again = track(drive, None, [], 0, settings=EXACT)
    np.testing.assert_array_equal(one.metres, again.metres)


@pytest.mark.parametrize('by', [THESIS, UNFILTERED])
def test_a_camera_that_knows_takes_the_error_away(oracle, by):
    drive, local_map, predictor = oracle(np.full(6, 1e-4))
    found = track(drive, local_map, [predictor], 3, by=by, settings=EXACT)
    # The camera is a metre from base: its yaw error counts there too.
    assert found.metres.max() < 2e-3 and found.radians.max() < 2e-3
    assert found.skipped == 0 and len(found.xi) == 9


def test_the_errors_that_come_with_observations_fit_their_covariances(oracle):
    scale = np.array([0.2, 0.1, 0.05, 0.01, 0.02, 0.03])
    drive, local_map, predictor = oracle(scale)
    runs = [track(drive, local_map, [predictor], seed, settings=EXACT) for seed in range(30)]
    xi, C = (np.concatenate(part) for part in ([r.xi for r in runs], [r.covariances for r in runs]))
    nees = np.einsum('ni,nij,nj->n', xi, np.linalg.inv(C), xi)
    assert nees.mean() == pytest.approx(6.0, abs=0.7)
    filtered = np.concatenate([r.metres for r in runs])
    raw = np.linalg.norm(xi[:, :3], axis=1)
    assert filtered.mean() < raw.mean() * 1.05


def test_the_vehicles_filter_moves_by_inertial_samples(tmp_path):
    bend = BendWithImu()
    drive = record(tmp_path, bend, bend.truth(), SMALL)
    assert drive.imu.forces.shape == (91, 3)
    right = replace(EXACT, start_translation=0.0, start_rotation=0.0)
    found = track(drive, None, [], 0, by=VEHICLE, settings=right)
    assert found.metres.max() < 0.02 and found.radians.max() < 2e-3
    # Without the sensor's place it would feel gravity the wrong way up.
    hung = replace(drive, imu=replace(drive.imu, T_base_imu=np.eye(4)))
    assert track(hung, None, [], 0, by=VEHICLE, settings=right).metres.max() > 0.5


def test_the_vehicles_filter_takes_a_wrong_start_away(oracle):
    scale = np.array([0.2, 0.1, 0.05, 0.01, 0.02, 0.03])
    drive, local_map, predictor = oracle(scale, BendWithImu())
    runs = [track(drive, local_map, [predictor], n, by=VEHICLE, settings=EXACT) for n in range(8)]
    last = np.array([r.metres[-1] for r in runs])
    assert last.max() < 0.5
    assert np.mean(last) < np.mean([np.linalg.norm(r.xi[:, :3], axis=1).mean() for r in runs])


def test_the_vehicles_filter_needs_inertial_samples(tmp_path):
    drive = record(tmp_path, StreetWithCamera(), StreetWithCamera().truth(), SMALL)
    assert drive.imu is None
    with pytest.raises(ConfigError, match='needs inertial samples'):
        track(drive, None, [], 0, by=VEHICLE)


def test_covariances_of_components_are_those_of_drawn_poses():
    rng = np.random.default_rng(1)
    T = pose_matrix(np.array([5.0, -2.0, 1.0, 0.1, -0.2, 1.3]))
    deviations = np.array([0.2, 0.1, 0.05, 0.01, 0.02, 0.03])
    draws = [T @ se3.exp(rng.normal(size=6) * deviations) for _ in range(4000)]
    sampled = np.cov(np.array([pose_vector(one) for one in draws]).T)
    found = component_covariance(T, np.diag(deviations**2))
    root = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(
        found / np.outer(root, root), sampled / np.outer(root, root), atol=0.08
    )


def made_track(metres, degrees, seed=0) -> Track:
    metres = np.asarray(metres, float)
    nothing = np.zeros((0, 6)), np.zeros((0, 6, 6))
    T = np.tile(np.eye(4), (len(metres), 1, 1))
    nees = 2.0 * metres
    return Track(seed, T, metres, np.deg2rad(degrees), nees, *nothing, skipped=1)


def test_figures_count_all_images_of_all_runs():
    one, lost = made_track([1.0, 2.0, 3.0], [1, 1, 1]), made_track([4.0, 5.0, 9.0], [2, 2, 8], 1)
    found = figures_of([one, lost])
    assert found['t_max_m'] == 9.0 and found['t_mean_m'] == 4.0 and found['t_median_m'] == 3.5
    assert found['r_median_deg'] == pytest.approx(1.5) and found['r_max_deg'] == pytest.approx(8.0)
    assert (found['runs'], found['diverged']) == (2, 1)
    assert found['nees_mean'] == 8.0
    assert found['skipped_share'] == pytest.approx(2 / 6)
    back = made_track([*[20.0] * 50, *[0.5] * 50], np.ones(100))
    assert not back.diverged, 'it found back'


def test_ways_are_the_rows_of_the_table():
    networks = {
        'cmrnet': [Predictor([Cmrnet(SMALL)])],
        'mcd': [Predictor([Cmrnet(replace(SMALL, dropout=0.3))])],
        'der': [Predictor([Cmrnet(replace(SMALL, head='evidential'))])],
    }
    found = ways(networks, THESIS)
    assert list(found) == ['motion', 'unfiltered', 'mcd', 'der']
    assert found['unfiltered'].by == UNFILTERED and found['der'].by == THESIS
    found = ways(networks, VEHICLE)
    assert list(found) == ['motion', 'inertial', 'unfiltered', 'mcd', 'der']
    assert found['motion'].by == THESIS and found['der'].by == found['inertial'].by == VEHICLE


def test_what_does_not_fit_is_refused(tmp_path):
    street = StreetWithCamera()
    drive = record(tmp_path / 'frames', street, street.truth(), SMALL)
    local_map = street_map(tmp_path / 'map')
    with pytest.raises(ConfigError, match='plain'):
        track(drive, local_map, [Predictor([Cmrnet(SMALL)])], 0)
    with pytest.raises(ConfigError, match='recorded for images'):
        track(drive, local_map, [Predictor([Cmrnet(replace(SMALL, focal=50.0))])], 0)
    street.camera = None
    with pytest.raises(DataError, match='no camera'):
        record(tmp_path / 'none', street, street.truth(), SMALL)


def test_the_command_tracks_with_networks(tmp_path, monkeypatch, capsys):
    assert CAMERA.width == 128
    street_map(tmp_path / 'map')
    monkeypatch.setattr(command, 'drive_from', lambda arguments: StreetWithCamera())
    monkeypatch.setattr(command, 'span_ns', lambda *a: (0, None))
    for role, head in (('plain', 'quaternion'), ('der', 'evidential')):
        save_network(tmp_path / f'{role}.safetensors', Cmrnet(replace(SMALL, head=head)), {})
    out = tmp_path / 'out'
    line = ['made_up', '--map', f'{tmp_path}/map', '--out', str(out), '--runs', '2', '--quiet']
    line += ['--filter', 'thesis']
    line += [
        '--networks',
        f'cmrnet={tmp_path}/plain.safetensors',
        f'der={tmp_path}/der.safetensors',
    ]
    assert command.main(line) == 0
    figures = json.loads((out / 'results.json').read_text())['ways']
    assert list(figures) == ['motion', 'unfiltered', 'der']
    assert figures['der']['runs'] == 2
    with np.load(out / 'tracks.npz') as kept:
        T = kept['der_1_pose']
        metres = [
            np.linalg.norm(kept[f'der_{seed}_pose'][:, :3, 3] - truth_positions(), axis=1)
            for seed in (0, 1)
        ]
    assert T.shape == (9, 4, 4)
    assert figures['der']['t_mean_m'] == pytest.approx(np.mean(metres))
    assert (out / 'heat.png').stat().st_size > 5000
    assert 'unfiltered' in capsys.readouterr().out
    assert command.main([*line, '--set', 'speed=1']) == 1
    assert 'no setting' in capsys.readouterr().err
    assert command.main([*line, '--filter', 'vehicle']) == 1
    error = capsys.readouterr().err
    assert 'inertial samples' in error and error.count('\n') == 1, error


def test_the_command_says_when_the_map_was_never_in_sight(command_line, tmp_path, caplog, capsys):
    away = StreetWithCamera().truth()
    T = away.T_world_body.copy()
    T[:, 1, 3] += 5000.0
    Trajectory(away.stamps_ns, T).write_tum(tmp_path / 'away.tum')
    line = [*command_line, '--networks', 'der=one.safetensors', '--frames', 'kept']
    assert command.main([*line, '--poses', 'away.tum']) == 0
    assert 'der never saw the map' in caplog.text
    assert command.main(line) == 1
    assert 'recorded with other poses; name another folder' in capsys.readouterr().err


def truth_positions():
    return StreetWithCamera().truth().positions[1:]


@pytest.fixture
def command_line(tmp_path, monkeypatch):
    """Return a command without networks, and write those that it may name."""
    street_map(tmp_path / 'map')
    monkeypatch.setattr(command, 'drive_from', lambda arguments: StreetWithCamera())
    monkeypatch.setattr(command, 'span_ns', lambda *a: (0, None))
    der = replace(SMALL, head='evidential')
    for name, config in {
        'plain': SMALL, 'one': der, 'two': der, 'three': der, 'zoomed': replace(der, focal=50.0),
    }.items():  # fmt: skip
        save_network(tmp_path / f'{name}.safetensors', Cmrnet(config), {})
    monkeypatch.chdir(tmp_path)
    return [
        'made_up', '--map', 'map', '--out', 'out', '--runs', '1', '--quiet', '--filter', 'thesis',
    ]  # fmt: skip


def test_the_command_refines_in_stages(command_line, monkeypatch):
    seen = {}

    def remembered(drive, local_map, chosen, *rest):
        seen.update(chosen)
        return study_tracks(drive, local_map, chosen, *rest)

    study_tracks = command.tracks
    monkeypatch.setattr(command, 'tracks', remembered)
    line = [
        *command_line, '--networks', 'der=one.safetensors', 'deep=one.safetensors',
        'rough_first=plain.safetensors', '--second', 'deep=two.safetensors',
        'rough_first=two.safetensors', '--third', 'deep=three.safetensors',
    ]  # fmt: skip
    assert command.main(line) == 0
    counts = {name: len(way.stages) for name, way in seen.items()}
    assert counts == {'motion': 0, 'der': 1, 'deep': 3, 'rough_first': 2}
    assert seen['rough_first'].by == THESIS, 'the last network says how sure it is'
    assert [p.kind for p in seen['rough_first'].stages] == ['plain', 'der']
    with open('out/results.json') as file:
        assert list(json.load(file)['ways']) == list(counts)


@pytest.mark.parametrize(
    ('stages', 'message'),
    [
        (['--second', 'mcd=two.safetensors'], 'stage 2 has mcd, the stage before has not'),
        (['--third', 'der=two.safetensors'], 'stage 3 has der, the stage before has not'),
        (['--second', 'der=zoomed.safetensors'], 'der, stage 2, takes images'),
        (['--second', 'der'], 'expected NAME=FILE'),
    ],
)
def test_stages_that_do_not_fit_are_refused(command_line, capsys, stages, message):
    assert command.main([*command_line, '--networks', 'der=one.safetensors', *stages]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1, error
