"""The inertial unit feels the true motion, with the noise of its data sheet."""

import numpy as np
import pytest

from bags.simulation import car
from bags.simulation.inertial import GRAVITY, IMUS, InertialLog, felt, imu_model, measured
from bags.simulation.itinerary import JourneyConfig
from bags.simulation.journey import Journey
from bags.simulation.street_map import street_map
from bags.street.town import Ground
from lcd_common import se3
from lcd_common.errors import ConfigError

RATE = 100.0
MOUNTING = car.IMU.T_parent_child


@pytest.fixture(scope='module')
def journey() -> Journey:
    return Journey(street_map(3), Ground(np.random.default_rng(1)), JourneyConfig(length=600.0), 3)


def integrated(log: InertialLog, T: se3.Array, velocity: se3.Array) -> tuple[se3.Array, se3.Array]:
    """Integrate by the midpoint rule; return the last pose and velocity."""
    R, p, v, dt = T[:3, :3], T[:3, 3], velocity, 1.0 / RATE
    for k in range(len(log.angular_velocity) - 1):
        rate = 0.5 * (log.angular_velocity[k] + log.angular_velocity[k + 1])
        after = R @ se3.so3_exp(rate * dt)
        force = 0.5 * (R @ log.linear_acceleration[k] + after @ log.linear_acceleration[k + 1])
        a = force - [0.0, 0.0, GRAVITY]
        p, v, R = p + v * dt + 0.5 * a * dt**2, v + a * dt, after
    return se3.from_rotation_translation(R, p), v


def five_seconds(journey: Journey, begin: float) -> tuple[se3.Array, se3.Array, se3.Array]:
    """Return times, true poses of the unit and its velocity at the begin."""
    time_s = begin + np.arange(501) / RATE
    h = 1e-4
    around = journey.T_world_base([begin - h, begin + h]) @ MOUNTING
    velocity = (around[1, :3, 3] - around[0, :3, 3]) / (2 * h)
    return time_s, journey.T_world_base(time_s) @ MOUNTING, velocity


def test_a_faultless_unit_integrates_to_the_truth(journey: Journey) -> None:
    for begin in np.arange(3.0, journey.duration_s - 6.0, 7.0):
        time_s, T, velocity = five_seconds(journey, begin)
        end, _ = integrated(felt(journey.T_world_base, MOUNTING, time_s), T[0], velocity)
        metres, radians = se3.distance(T[-1], end)
        assert metres < 0.02 and radians < 5e-4


@pytest.mark.parametrize('name', IMUS)
def test_a_real_unit_integrates_within_its_error_budget(journey: Journey, name: str) -> None:
    """Position error after t by gyro bias and noise (through gravity), accelerometer likewise."""
    model, t = imu_model(name), 5.0
    time_s, T, velocity = five_seconds(journey, 10.0)
    true = felt(journey.T_world_base, MOUNTING, time_s)
    faultless, _ = integrated(true, T[0], velocity)
    angle = np.sqrt(
        model.gyro_noise**2 * t + (model.gyro_bias * t) ** 2 + model.gyro_walk**2 * t**3 / 3
    )
    level = np.sqrt(  # horizontal, one axis
        model.accelerometer_noise**2 * t**3 / 3
        + (model.accelerometer_bias * t**2 / 2) ** 2
        + model.accelerometer_walk**2 * t**5 / 20
        + GRAVITY**2 * (model.gyro_noise**2 * t**5 / 20 + (model.gyro_bias * t**3 / 6) ** 2)
        + GRAVITY**2 * model.gyro_walk**2 * t**7 / 252
    )
    errors = []
    for seed in range(60):
        end, _ = integrated(measured(true, model, RATE, seed), T[0], velocity)
        difference = se3.inverse(faultless) @ end
        errors.append([*difference[:2, 3] / level, *se3.so3_log(difference[:3, :3]) / angle])
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    # 60 draws: the standard deviation is known to 9 %; the car turns meanwhile, too.
    assert (spread > 0.7).all() and (spread < 1.35).all()


def test_noise_has_the_allan_deviations_of_the_model() -> None:
    model, count = imu_model('mems'), 400_000
    still = InertialLog(np.zeros((count, 3)), np.zeros((count, 3)))
    log = measured(still, model, RATE, 4)
    for samples, noise, walk in (
        (log.angular_velocity, model.gyro_noise, model.gyro_walk),
        (log.linear_acceleration, model.accelerometer_noise, model.accelerometer_walk),
    ):
        short = np.diff(samples, axis=0).std() / np.sqrt(2.0)
        assert short == pytest.approx(noise * np.sqrt(RATE), rel=0.02)
        tau = 100.0  # seconds; there the walk rules: Allan variance K^2 tau / 3
        means = samples.reshape(-1, int(tau * RATE), 3).mean(axis=1)
        allan = np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2))
        expected = np.sqrt(noise**2 / tau + walk**2 * tau / 3.0)
        assert allan == pytest.approx(expected, rel=0.35)


def test_standing_still_is_gravity_alone() -> None:
    log = felt(lambda t: np.tile(np.eye(4), (len(t), 1, 1)), np.eye(4), np.arange(5) / RATE)
    np.testing.assert_allclose(log.linear_acceleration, [[0.0, 0.0, GRAVITY]] * 5)
    np.testing.assert_allclose(log.angular_velocity, 0.0)


def test_an_unknown_unit_is_named() -> None:
    with pytest.raises(ConfigError, match="one of rt3003, mems, got 'xsens'"):
        imu_model('xsens')
