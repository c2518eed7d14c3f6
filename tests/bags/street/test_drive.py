"""The made-up drive is a Drive: lazy, in stamp order, consistent with its truth, repeatable."""

from itertools import pairwise

import numpy as np
import pytest

from bags.records import GnssFix, ImuSample, LidarScan, TruthPose
from bags.street import LidarConfig, Route, StreetConfig, StreetDrive
from bags.street.drive import T_BASE_IMU, T_BASE_LIDAR
from bags.topics import ORDER
from lcd_common import se3
from lcd_common.errors import ConfigError

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
SMALL = LidarConfig(columns=60)


@pytest.fixture(scope='module')
def drive() -> StreetDrive:
    return StreetDrive('loop', lidar=SMALL)


def test_streams_say_what_the_records_are(drive: StreetDrive) -> None:
    route = Route().through([(0, 0), (12, 0)])
    short = StreetDrive(route, lidar=SMALL)
    records = list(short.records())
    for stream, kind in zip(
        short.streams(), (LidarScan, ImuSample, GnssFix, TruthPose), strict=True
    ):
        stamps = [r.stamp_ns for r in records if isinstance(r, kind)]
        assert (len(stamps), stamps[0], stamps[-1]) == (
            stream.count,
            stream.first_ns,
            stream.last_ns,
        )
    truth = short.truth()
    assert [r.stamp_ns for r in records if isinstance(r, TruthPose)] == truth.stamps_ns.tolist()


def test_records_come_in_stamp_order_and_the_sweep_last(drive: StreetDrive) -> None:
    records = list(drive.records(START + 2 * SECOND, START + 3 * SECOND))
    keys = [(r.stamp_ns, ORDER[type(r)]) for r in records]
    assert keys == sorted(keys)
    assert (keys[0][0], keys[-1][0]) == (START + 2 * SECOND, START + 3 * SECOND)
    assert sum(isinstance(r, LidarScan) for r in records) == 11
    assert sum(isinstance(r, ImuSample) for r in records) == 101


def test_only_the_kinds_asked_for_are_made(drive: StreetDrive) -> None:
    fresh = StreetDrive('loop', lidar=SMALL)
    kinds = {type(r) for r in fresh.records(end_ns=START + SECOND, kinds=(ImuSample, GnssFix))}
    assert kinds == {ImuSample, GnssFix}
    assert '_scanner' not in vars(fresh)  # the town was not even built


def test_any_part_read_first_gives_the_same_sweep(drive: StreetDrive) -> None:
    other = StreetDrive('loop', lidar=SMALL)
    late = other.scan(40)
    next(iter(drive.records(kinds=(LidarScan,))))
    np.testing.assert_array_equal(drive.scan(40).cloud.xyz, late.cloud.xyz)
    np.testing.assert_array_equal(drive.scan(40).cloud.intensity, late.cloud.intensity)
    assert not np.array_equal(drive.scan(40).cloud.xyz[:50], drive.scan(41).cloud.xyz[:50])


def test_another_seed_is_another_town(drive: StreetDrive) -> None:
    other = StreetDrive('loop', StreetConfig(seed=1), SMALL).scan(0).cloud
    assert len(other) != len(drive.scan(0).cloud)


def test_the_car_stands_on_the_ground(drive: StreetDrive) -> None:
    for index in (0, 200, 400):
        xyz = drive.scan(index).cloud.xyz
        below = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) < 4.5]
        assert len(below) > 50
        # Crown and kerb of the street move single points by some centimetres.
        assert np.median(below[:, 2]) == pytest.approx(-1.73, abs=0.08)


def test_sweeps_agree_about_where_walls_are(drive: StreetDrive) -> None:
    """Two sweeps, taken to the world by the truth, must lie on the same surfaces."""
    from scipy.spatial import cKDTree

    clean = StreetDrive('loop', lidar=LidarConfig(columns=720, range_noise=0.0, dropout=0.0))
    T_world_base = clean.truth().T_world_body
    clouds = [
        se3.transform_points(T_world_base[i] @ T_BASE_LIDAR, clean.scan(i).cloud.xyz.astype(float))
        for i in (300, 303)
    ]
    nearest = cKDTree(clouds[0]).query(clouds[1])[0]
    shifted = cKDTree(clouds[0]).query(clouds[1] + [0.5, 0.5, 0.0])[0]
    assert np.median(nearest) < 0.1
    assert np.median(nearest) < 0.7 * np.median(shifted)


def test_the_imu_integrates_to_the_truth(drive: StreetDrive) -> None:
    quiet = StreetDrive('loop', StreetConfig(gyro_noise=0.0, accelerometer_noise=0.0), SMALL)
    begin, seconds = 10.0, 8.0
    samples = list(
        quiet.records(
            START + round(begin * SECOND),
            START + round((begin + seconds) * SECOND),
            kinds=(ImuSample,),
        )
    )
    T = quiet.T_world_base(begin)[0] @ T_BASE_IMU
    ahead, behind = (quiet.T_world_base(begin + d)[0] @ T_BASE_IMU for d in (1e-4, -1e-4))
    velocity = (ahead[:3, 3] - behind[:3, 3]) / 2e-4
    R, p = T[:3, :3], T[:3, 3]
    dt = 0.01
    for now, after in pairwise(samples):  # midpoint rule
        rate = 0.5 * (now.angular_velocity + after.angular_velocity)
        R_after = R @ se3.so3_exp(rate * dt)
        force = 0.5 * (R @ now.linear_acceleration + R_after @ after.linear_acceleration)
        acceleration = force - [0.0, 0.0, 9.81]
        p = p + velocity * dt + 0.5 * acceleration * dt**2
        velocity = velocity + acceleration * dt
        R = R_after
    expected = quiet.T_world_base(begin + seconds)[0] @ T_BASE_IMU
    assert np.linalg.norm(p - expected[:3, 3]) < 0.05
    assert np.degrees(np.linalg.norm(se3.so3_log(R.T @ expected[:3, :3]))) < 0.05


def test_fixes_scatter_around_the_antenna(drive: StreetDrive) -> None:
    """A second way from degrees to metres: WGS-84 to ECEF, differences turned to east-north-up."""
    fixes = [r for r in drive.records(kinds=(GnssFix,)) if isinstance(r, GnssFix)]
    enu = _enu(np.array([[f.latitude_deg, f.longitude_deg, f.altitude_m] for f in fixes]))
    T_base_gps = next(m.T_parent_child for m in drive.mountings if m.child == 'gps')
    times = np.array([f.stamp_ns - START for f in fixes]) * 1e-9
    error = enu - (drive.T_world_base(times) @ T_base_gps)[:, :3, 3]
    assert np.abs(error.mean(axis=0)).max() < 4 * 0.8 / np.sqrt(len(fixes))
    assert error.std() == pytest.approx(0.8, rel=0.2)
    assert fixes[0].covariance_enu is not None
    np.testing.assert_allclose(fixes[0].covariance_enu, 0.64 * np.eye(3))


def _enu(lat_lon_alt: np.ndarray) -> np.ndarray:
    origin = np.array([49.0, 8.4, 0.0])

    def ecef(rows: np.ndarray) -> np.ndarray:
        lat, lon = np.radians(rows[:, 0]), np.radians(rows[:, 1])
        n = 6378137.0 / np.sqrt(1 - 6.69437999014e-3 * np.sin(lat) ** 2)
        flat = (n + rows[:, 2]) * np.cos(lat)
        z = (n * (1 - 6.69437999014e-3) + rows[:, 2]) * np.sin(lat)
        return np.column_stack([flat * np.cos(lon), flat * np.sin(lon), z])

    lat, lon = np.radians(origin[:2])
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return (ecef(lat_lon_alt) - ecef(origin[None])) @ np.array([east, north, up]).T


def test_places_look_different(drive: StreetDrive) -> None:
    """Range images of places far apart correlate less than those of a place seen again."""
    truth = drive.truth()
    step = np.linalg.norm(truth.positions[:, None] - truth.positions[None], axis=2)

    def image(index: int) -> np.ndarray:
        xyz = drive.scan(index).cloud.xyz
        xyz = xyz[xyz[:, 2] > -1.2]  # the ground looks alike everywhere
        bins = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])) // 6 % 60
        distance = np.hypot(xyz[:, 0], xyz[:, 1])
        return np.array(
            [np.median(distance[bins == b]) if np.any(bins == b) else 100.0 for b in range(60)]
        )

    images = np.log([image(i) for i in range(0, 300, 30)])
    for i in range(len(images)):
        near = np.abs(image_difference(images[i], np.log(image(30 * i + 1))))
        for j in range(len(images)):
            if step[30 * i, 30 * j] > 20.0:
                assert near < np.abs(image_difference(images[i], images[j]))


def image_difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.mean(np.abs(a - b)))


def test_an_unknown_route_is_an_error() -> None:
    with pytest.raises(ConfigError, match='loop, abrupt_u_turn'):
        StreetDrive('square')
