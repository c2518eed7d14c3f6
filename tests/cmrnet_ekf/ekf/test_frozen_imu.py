"""A sensor that is frozen, or gaps that were filled with straight lines."""

import gtsam
import numpy as np

from cmrnet_ekf.ekf.frozen_imu import FrozenImu


def test_noise_is_life_and_repetition_is_not() -> None:
    rng = np.random.default_rng(0)
    watch = FrozenImu(after=10)
    at_rest = [watch.check(*rng.normal(size=(2, 3)) * 1e-3) for _ in range(1000)]
    assert not any(at_rest)
    stuck = [watch.check(np.zeros(3), np.array([0.0, 0.0, 9.81])) for _ in range(30)]
    assert not any(stuck[:10]) and all(stuck[12:])
    assert not watch.check(*rng.normal(size=(2, 3)))


def test_zero_switches_it_off() -> None:
    watch = FrozenImu(after=0)
    assert not any(watch.check(np.zeros(3), np.zeros(3)) for _ in range(100))


def test_the_filled_gaps_of_kitti_00_are_found() -> None:
    """Eight straight lines of a second and a half, counted by hand in the file."""
    path = gtsam.findExampleDataFile('KittiEquivBiasedImu.txt')
    rows = np.loadtxt(path, skiprows=1)
    watch = FrozenImu(after=10)
    frozen = np.array([watch.check(row[5:8], row[2:5]) for row in rows])
    begins = np.flatnonzero(frozen[1:] & ~frozen[:-1])
    assert len(begins) == 8
    assert 1100 < frozen.sum() < 1257
