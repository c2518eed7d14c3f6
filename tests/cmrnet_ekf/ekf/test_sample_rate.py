"""White noise of density n has the variance n^2 rate in each sample: the rate is measured."""

import numpy as np
import pytest

from cmrnet_ekf.ekf.ekf_settings import EkfSettings, MotionConfig, StartConfig
from cmrnet_ekf.ekf.observations import TwistObservation
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf

NOISE = 0.01
SETTINGS = EkfSettings(
    motion=MotionConfig(gyroscope_noise=NOISE, gyroscope_walk=0.0),
    start=StartConfig(gyroscope_bias=1e-6),
)
TURN, FORCE = np.array([0.01, -0.02, 0.3]), np.array([0.0, 0.0, 9.81])


def _fed(stamps_ns: list[int]) -> VehicleEkf:
    ekf = VehicleEkf(SETTINGS)
    ekf.start(0, np.eye(4))
    for stamp_ns in stamps_ns:
        ekf.add_imu(stamp_ns, TURN, FORCE)
    return ekf


def _turn_variance(ekf: VehicleEkf) -> float:
    estimate = ekf.estimate()
    assert estimate is not None
    return float(estimate.twist_covariance[5, 5])


def _stamps(rate_hz: float, seconds: float) -> list[int]:
    return [round(k * 1e9 / rate_hz) for k in range(round(seconds * rate_hz) + 1)]


@pytest.mark.parametrize('rate_hz', [50.0, 100.0, 400.0])
def test_the_published_turn_rate_is_as_noisy_as_its_sample(rate_hz: float) -> None:
    variance = _turn_variance(_fed(_stamps(rate_hz, 0.5)))
    assert variance == pytest.approx(NOISE**2 * rate_hz, rel=1e-3)


@pytest.mark.parametrize('rate_hz', [100.0, 400.0])
def test_it_is_the_spread_of_what_a_gyroscope_of_this_density_says(rate_hz: float) -> None:
    """Drawn as increments of the angle, whose variance n^2 t does not know of a rate."""
    rng = np.random.default_rng(0)
    rates = rng.normal(size=20_000) * NOISE * np.sqrt(1.0 / rate_hz) * rate_hz
    variance = _turn_variance(_fed(_stamps(rate_hz, 0.2)))
    assert variance == pytest.approx(rates.var(), rel=0.05)


@pytest.mark.parametrize('rate_hz', [100.0, 400.0])
def test_a_measured_turn_rate_is_believed_as_much(rate_hz: float) -> None:
    ekf = _fed(_stamps(rate_hz, 0.5))
    own, off = 0.02**2, 0.1
    twist = np.array([0.0, 0.0, 0.0, *TURN])
    twist[5] += off
    axes = (False, False, False, False, False, True)
    seen = TwistObservation(
        500_000_000, 'wheels', twist, own * np.eye(6), axes=axes, gyroscope_noise=NOISE
    )
    verdict = ekf.observe(seen)
    assert verdict.nis == pytest.approx(off**2 / (own + NOISE**2 * rate_hz), rel=1e-3)


def test_lost_samples_gaps_and_jitter_do_not_change_it() -> None:
    rng = np.random.default_rng(1)
    stamps = np.array(_stamps(400.0, 2.0))
    kept = stamps[rng.random(len(stamps)) > 0.15]
    kept = kept[(kept < 500_000_000) | (kept > 560_000_000)]  # within imu_hold
    kept = kept[(kept < 1_990_000_000) | (kept > 1_995_000_000)]
    kept = kept[(kept < 1_000_000_000) | (kept > 1_900_000_000)]  # longer than that
    jittered = kept + rng.integers(-20_000, 20_000, len(kept))
    variance = _turn_variance(_fed([int(stamp) for stamp in jittered if stamp > 0]))
    assert variance == pytest.approx(NOISE**2 * 400.0, rel=0.05)


def test_the_rate_is_known_right_after_a_start_and_another_one() -> None:
    """Samples that came before the start say how often they come."""
    ekf = VehicleEkf(SETTINGS)
    for stamp_ns in _stamps(400.0, 0.5):
        ekf.add_imu(stamp_ns, TURN, FORCE)
    for _ in range(2):
        ekf.start(500_000_000, np.eye(4))
        assert _turn_variance(ekf) == pytest.approx(NOISE**2 * 400.0, rel=1e-3)


def test_late_samples_take_their_places() -> None:
    """The rate is the same to the last bit in whatever order samples come."""
    stamps = _stamps(400.0, 0.3)
    rng = np.random.default_rng(2)
    assert _turn_variance(_fed(stamps)) == _turn_variance(_fed(list(rng.permutation(stamps))))
