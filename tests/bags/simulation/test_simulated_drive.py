"""The simulated drive is a Drive: lazy, in stamp order, consistent with its truth, repeatable."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bags.records import CameraImage, GnssFix, ImuSample, LidarScan, Record, TruthPose
from bags.simulation import car
from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.itinerary import JourneyConfig
from bags.simulation.journey import Journey
from bags.simulation.road_users import kept_clear
from bags.simulation.scene import Mover, Scene
from bags.simulation.town import SimulatedTown
from bags.street.mesh import Label
from bags.topics import ORDER, TOPICS
from lcd_common import se3
from lcd_common.errors import ConfigError

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
SHORT = JourneyConfig(length=300.0)
VLP16 = SensorsConfig(lidar='vlp16')


def make(seed: int = 3, run: int = 0, sensors: SensorsConfig = VLP16) -> SimulatedDrive:
    return SimulatedDrive(SimulatedTown(seed, size=3), run, SHORT, sensors)


@pytest.fixture(scope='module')
def drive() -> SimulatedDrive:
    return make()


def values(records: list[Record]) -> list[bytes]:
    """Return everything that each record holds."""
    out = []
    for record in records:
        parts = [repr((type(record).__name__, record.stamp_ns)).encode()]
        for value in vars(record).values():
            if hasattr(value, 'xyz'):
                parts += [value.xyz.tobytes(), value.intensity.tobytes()]
            else:
                parts.append(value.tobytes() if hasattr(value, 'tobytes') else repr(value).encode())
        out.append(b''.join(parts))
    return out


def test_streams_say_what_the_records_are(drive: SimulatedDrive) -> None:
    kinds = (ImuSample, GnssFix, TruthPose)
    records = list(drive.records(kinds=kinds))
    streams = {stream.topic: stream for stream in drive.streams()}
    assert set(streams) == {TOPICS[kind][0] for kind in (*kinds, LidarScan)}
    for kind in kinds:
        stamps = [r.stamp_ns for r in records if isinstance(r, kind)]
        stream = streams[TOPICS[kind][0]]
        assert (len(stamps), stamps[0], stamps[-1]) == (
            stream.count,
            stream.first_ns,
            stream.last_ns,
        )
    truth = drive.truth()
    assert streams['/points'].count == len(truth)
    assert [r.stamp_ns for r in records if isinstance(r, TruthPose)] == truth.stamps_ns.tolist()


def test_records_come_in_stamp_order_and_the_sweep_last(drive: SimulatedDrive) -> None:
    records = list(drive.records(START + 2 * SECOND, START + 3 * SECOND))
    keys = [(r.stamp_ns, ORDER[type(r)]) for r in records]
    assert keys == sorted(keys)
    assert (keys[0][0], keys[-1][0]) == (START + 2 * SECOND, START + 3 * SECOND)
    assert sum(isinstance(r, LidarScan) for r in records) == 11
    assert sum(isinstance(r, ImuSample) for r in records) == 101


def test_what_nobody_asks_for_costs_nothing() -> None:
    fresh = make()
    assert list(fresh.records(end_ns=START + SECOND, kinds=(ImuSample,)))
    assert '_caster' not in vars(fresh)  # the town was not even built


def test_same_seed_same_bytes_whatever_is_read_first(drive: SimulatedDrive) -> None:
    other = make()
    other.sweep(40)
    span = (START + 9 * SECOND, START + 10 * SECOND)
    assert values(list(other.records(*span))) == values(list(drive.records(*span)))


def test_other_seeds_and_runs_are_others(drive: SimulatedDrive) -> None:
    span = (START + 9 * SECOND, START + 9 * SECOND + SECOND // 2)
    ours = values(list(drive.records(*span)))
    for other in (make(seed=4), make(run=1)):
        theirs = values(list(other.records(*span)))
        assert not set(ours) & set(theirs)


def test_runs_see_the_same_town(drive: SimulatedDrive) -> None:
    """What stands in both runs lies at one place; the cars at the kerb do not."""
    other = make(run=1)
    clouds = []
    for each in (drive, other):
        truth = each.truth().T_world_body
        near = int(np.argmin(np.linalg.norm(truth[:, :3, 3] - truth[150, :3, 3], axis=1)))
        if each is other:
            away = np.linalg.norm(truth[:, :3, 3] - drive.truth().T_world_body[150, :3, 3], axis=1)
            near = int(np.argmin(away))
        sweep = each.sweep(near)
        T = truth[near] @ car.LIDAR.T_parent_child
        built = sweep.label == Label.BUILDING
        clouds.append(se3.transform_points(T, sweep.cloud.xyz[built].astype(float)))
    nearest = cKDTree(clouds[0]).query(clouds[1])[0]
    shifted = cKDTree(clouds[0]).query(clouds[1] + [0.7, 0.7, 0.0])[0]
    assert np.median(nearest) < 0.7 * np.median(shifted)


def test_two_sweeps_of_one_place_overlap_within_the_noise() -> None:
    """The same wall, from two poses half a second apart: point to plane by its neighbours."""
    dense = make(sensors=SensorsConfig(lidar='hdl64', imu='', gnss=False))
    truth = dense.truth().T_world_body
    clouds = []
    for index in (120, 125):
        sweep = dense.sweep(index)
        built = np.isin(sweep.label, (Label.BUILDING, Label.ROAD))
        T = truth[index] @ car.LIDAR.T_parent_child
        clouds.append(se3.transform_points(T, sweep.cloud.xyz[built].astype(float)))
    distances, indices = cKDTree(clouds[0]).query(clouds[1][::20], k=8)
    patch = clouds[0][indices]
    centred = patch - patch.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum('nki,nkj->nij', centred, centred))
    flat = (np.sqrt(spread[:, 0] / 8) < 0.03) & (spread[:, 1] > 30 * spread[:, 0])
    flat &= distances[:, -1] < 0.6
    off = np.einsum('ni,ni->n', clouds[1][::20] - patch.mean(axis=1), axes[:, :, 0])[flat]
    assert flat.sum() > 500
    sigma = np.hypot(dense.lidar.range_sigma_m, dense.lidar.beam_sigma_m)
    assert np.median(np.abs(off)) < sigma
    assert abs(np.median(off)) < 0.3 * sigma


def test_road_seen_from_afar_lies_where_it_lies() -> None:
    """The same road from 5 to 10 m and from 25 to 35 m away, by true poses."""
    dense = make(sensors=SensorsConfig(lidar='hdl64', imu='', gnss=False))
    truth = dense.truth().T_world_body
    off: list[np.ndarray] = []
    for index in range(40, len(truth) - 1, 40):
        gone = np.linalg.norm(truth[:index, :3, 3] - truth[index, :3, 3], axis=1)
        before = int(np.argmin(np.abs(gone - 30.0)))
        roads = []
        for at, least, most in ((index, 5.0, 10.0), (before, 25.0, 35.0)):
            sweep = dense.sweep(at)
            range_m = np.linalg.norm(sweep.cloud.xyz, axis=1)
            chosen = (sweep.label == Label.ROAD) & (range_m > least) & (range_m < most)
            T = truth[at] @ car.LIDAR.T_parent_child
            roads.append(se3.transform_points(T, sweep.cloud.xyz[chosen].astype(float)))
        if min(map(len, roads)) < 20:
            continue
        away, nearest = cKDTree(roads[0][:, :2]).query(roads[1][:, :2], distance_upper_bound=0.3)
        met = np.isfinite(away)
        off.append(roads[1][met, 2] - roads[0][nearest[met], 2])
    heights = np.concatenate(off)
    assert len(heights) > 200
    assert abs(np.median(heights)) < dense.lidar.range_sigma_m


def test_edges_of_the_image_are_those_of_the_sweep() -> None:
    """A point lies at the depth of its pixel; shifted by two pixels fewer do."""
    sensors = SensorsConfig(lidar='hdl64', imu='', gnss=False, camera=True)
    drive = make(sensors=sensors)
    assert drive.camera is not None
    renderer, share = drive._renderer, []
    for index in (60, 160):
        T_world_body = drive.truth().T_world_body[index]
        view = renderer.view(T_world_body @ car.CAMERA.T_parent_child, drive.camera, 0.1 * index)
        cloud = drive.sweep(index).cloud
        T = se3.inverse(car.CAMERA.T_parent_child) @ car.LIDAR.T_parent_child
        xyz = se3.transform_points(T, cloud.xyz.astype(float))
        ahead = xyz[xyz[:, 2] > 2.0]
        pixel = ahead @ drive.camera.K.T
        pixel = pixel[:, :2] / pixel[:, 2:]
        for shift in (0, -2, 2):
            u, v = np.round(pixel + np.array([0, shift])).astype(int).T
            inside = (u >= 0) & (v >= 2) & (u < drive.camera.width) & (v < drive.camera.height - 2)
            depth = view.depth_m[v[inside], u[inside]]
            near = np.abs(depth - ahead[inside, 2]) < 0.03 * ahead[inside, 2]
            share.append(float(near.mean()))
    whole, up, down = np.array(share).reshape(-1, 3).T
    assert whole.min() > 0.85, whole
    assert (whole > np.maximum(up, down) + 0.02).all()


def test_the_car_stands_on_the_road(drive: SimulatedDrive) -> None:
    for index in (50, 150, 250):
        sweep = drive.sweep(index)
        road = sweep.cloud.xyz[sweep.label == Label.ROAD]
        below = road[np.hypot(road[:, 0], road[:, 1]) < 9.0]
        assert len(below) > 50
        assert np.median(below[:, 2]) == pytest.approx(-1.73, abs=0.12)


def test_moving_points_are_those_of_moving_things() -> None:
    busy = SimulatedDrive(3, 0, JourneyConfig(length=1000.0), VLP16)
    truth = busy.truth().T_world_body
    movers = busy.town.scene(0).movers
    counted = 0
    for index in range(0, len(truth), 10):
        there = [T[:2, 3] for m in movers if (T := m.at(index / 10.0)) is not None]
        if not there or cKDTree(there).query(truth[index, :2, 3])[0] > 12.0:
            continue
        sweep = busy.sweep(index)
        by_label = np.isin(sweep.label, (Label.MOVING_CAR, Label.MOVING_PERSON))
        np.testing.assert_array_equal(sweep.moving, by_label)
        T = truth[index] @ car.LIDAR.T_parent_child
        world = se3.transform_points(T, sweep.cloud.xyz[sweep.moving].astype(float))
        counted += len(world)
        if len(world):
            assert cKDTree(there).query(world[:, :2])[0].max() < 3.6
    assert counted > 100


def test_who_would_run_into_the_car_stays_at_home() -> None:
    town = SimulatedTown(3, size=3)
    journey = Journey(town.streets, town.ground, SHORT, seed=3)
    time_s = np.arange(0.0, journey.duration_s, 0.5)
    T = journey.T_world_base(time_s)
    aside = T @ se3.from_rotation_translation(np.eye(3), [0.0, 3.0, 0.0])
    mesh = town.scene().movers[0].mesh
    crash, passing = Mover(mesh, time_s, T), Mover(mesh, time_s, aside)
    later = Mover(mesh, time_s + 1000.0, T)
    kept = kept_clear(Scene(mesh, (crash, passing, later)), journey)
    assert kept.movers == (passing, later)


def test_the_car_drives_through_nothing() -> None:
    """Rays along the way, at the car's sides and heights, meet no parked car, wall or pole."""
    drive = SimulatedDrive(3, 0, JourneyConfig(length=1200.0), VLP16)
    time_s = np.arange(0.0, drive.journey.duration_s, 0.02)
    half_metres = (2.0 * drive.journey.travelled(time_s)).astype(int)
    T = drive.journey.T_world_base(time_s[np.unique(half_metres, return_index=True)[1]])
    for side in (-0.9, 0.0, 0.9):
        for height in (0.4, 1.0, 1.73):
            at = T[:, :3, 3] + side * T[:, :3, 1] + height * T[:, :3, 2]
            step = np.diff(at, axis=0)
            metres = np.linalg.norm(step, axis=1)
            hits = drive._caster.cast(at[:-1], step / metres[:, None], time_s=-1.0)
            assert (hits.range_m > metres).all()


def test_sensors_sit_where_kittis_do() -> None:
    """Published: velodyne 1.73 m, camera 1.65 m, inertial unit 0.93 m above the road."""
    mountings = {
        m.child: m.T_parent_child for m in make(sensors=SensorsConfig(camera=True)).mountings
    }
    heights = {child: T[2, 3] for child, T in mountings.items()}
    expected = {'lidar': 1.73, 'camera': 1.65, 'imu': 0.93, 'gps': 0.93}
    assert heights == pytest.approx(expected, abs=0.03)
    assert mountings['camera'][0, 3] == pytest.approx(0.27, abs=0.03)
    assert mountings['imu'][0, 3] == pytest.approx(-0.81, abs=0.03)
    np.testing.assert_allclose(mountings['camera'][:3, 2], [1.0, 0.0, 0.0], atol=0.02)


def test_images_come_with_the_sweeps() -> None:
    seeing = make(sensors=SensorsConfig(lidar='vlp16', camera=True, imu='', gnss=False))
    span = (START + 9 * SECOND, START + 9 * SECOND + SECOND // 10)
    records = list(seeing.records(*span, kinds=(CameraImage, TruthPose)))
    assert [type(r) for r in records] == [TruthPose, CameraImage] * 2
    image = records[1]
    assert isinstance(image, CameraImage) and seeing.camera is not None
    assert image.pixels.shape == (seeing.camera.height, seeing.camera.width, 3)
    assert image.pixels.dtype == np.uint8 and image.pixels.std() > 10
    assert values([seeing.image(90)]) == values([image])


def test_a_sweep_while_driving_has_times() -> None:
    moving = make(sensors=SensorsConfig(lidar='vlp16', point_time=True, imu='', gnss=False))
    cloud = moving.scan(100).cloud
    assert cloud.time_s is not None
    assert 0.0 <= cloud.time_s.min() < 0.01 and 0.09 < cloud.time_s.max() < 0.1


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match=r"a lidar is one of hdl64.*got 'hdl65'"):
        make(sensors=SensorsConfig(lidar='hdl65'))
    with pytest.raises(ConfigError, match='an imu is one of'):
        make(sensors=SensorsConfig(imu='xsens'))
