"""The filter as a whole: batch least squares by GTSAM, order of arrival, limits."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from followed_drive import CAMERA, MOTION, START, START_POSE, TRUTH, camera, feed, follow, started
from gtsam.symbol_shorthand import B, V, X

from cmrnet_ekf.ekf.ekf_settings import ConstraintConfig, EkfSettings, GateConfig, HistoryConfig
from cmrnet_ekf.ekf.observations import (
    Observation,
    PositionObservation,
    RelativeObservation,
    TwistObservation,
)
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf
from lcd_common import se3
from lcd_common.errors import DataError


def test_it_is_the_batch_solution_of_gtsam() -> None:
    """Samples, poses, a motion and a position: the last state's mean and covariance."""
    rng = np.random.default_rng(0)
    n = 100
    turns = TRUTH.turn_rates + rng.normal(size=TRUTH.turn_rates.shape) * MOTION.gyroscope_noise * 3
    forces = TRUTH.forces + rng.normal(size=TRUTH.forces.shape) * MOTION.accelerometer_noise * 3
    off = [rng.normal(size=6) * np.sqrt(np.diag(CAMERA)) for _ in range(2)]
    motion = se3.inverse(TRUTH.T_map_body[0]) @ TRUTH.T_map_body[n]
    motion = motion @ se3.exp(rng.normal(size=6) * 0.004)
    motion_covariance = np.diag([0.02**2] * 3 + [0.003**2] * 3)
    antenna = np.array([0.5, -0.2, 1.0])
    T_end = TRUTH.T_map_body[2 * n]
    position = T_end[:3, :3] @ antenna + T_end[:3, 3] + [0.1, -0.05, 0.08]

    ekf = started()
    for k in range(2 * n):
        ekf.add_imu(int(TRUTH.stamps_ns[k]), turns[k], forces[k])
    ekf.observe(camera(n, off[0]))
    ekf.observe(camera(2 * n, off[1]))
    ekf.observe(RelativeObservation(int(TRUTH.stamps_ns[n]), 'odom', 0, motion, motion_covariance))
    ekf.observe(
        PositionObservation(
            int(TRUTH.stamps_ns[2 * n]), 'gps', position, 0.2**2 * np.eye(3), antenna
        )
    )
    ours = ekf.estimate()
    assert ours is not None

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(MOTION.gravity)
    params.setAccelerometerCovariance(np.eye(3) * MOTION.accelerometer_noise**2)
    params.setGyroscopeCovariance(np.eye(3) * MOTION.gyroscope_noise**2)
    params.setBiasAccCovariance(np.eye(3) * MOTION.accelerometer_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * MOTION.gyroscope_walk**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    pose_prior = _noise(se3.gtsam_covariance(START_POSE))
    graph.addPriorPose3(X(0), gtsam.Pose3(TRUTH.T_map_body[0]), pose_prior)
    graph.addPriorVector(V(0), TRUTH.velocities[0], _noise(START.velocity**2 * np.eye(3)))
    bias_prior = np.diag([START.accelerometer_bias**2] * 3 + [START.gyroscope_bias**2] * 3)
    graph.addPriorConstantBias(B(0), gtsam.imuBias.ConstantBias(), _noise(bias_prior))
    for i in range(3):
        values.insert(X(i), gtsam.Pose3(TRUTH.T_map_body[i * n]))
        values.insert(V(i), TRUTH.velocities[i * n])
        values.insert(B(i), gtsam.imuBias.ConstantBias())
    for i in range(2):
        total = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
        for k in range(i * n, (i + 1) * n):
            total.integrateMeasurement(forces[k], turns[k], 0.01)
        graph.add(gtsam.CombinedImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(i), B(i + 1), total))
        seen = gtsam.Pose3(camera((i + 1) * n, off[i]).T_map_sensor)
        graph.addPriorPose3(X(i + 1), seen, _noise(se3.gtsam_covariance(CAMERA)))
    between = _noise(se3.gtsam_covariance(motion_covariance))
    graph.add(gtsam.BetweenFactorPose3(X(0), X(1), gtsam.Pose3(motion), between))
    graph.add(gtsam.GPSFactorArm(X(2), position, antenna, _noise(0.2**2 * np.eye(3))))
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, values)

    metres, radians = se3.distance(ours.T_map_body, values.atPose3(X(2)).matrix())
    theirs = se3.covariance_from_gtsam(marginals.marginalCovariance(X(2)))
    # A hundredth of a sigma: a filter linearises once, the batch until it has settled.
    assert metres < 0.01 * np.sqrt(theirs[0, 0]) + 1e-4
    assert radians < 0.05 * np.sqrt(theirs[3, 3])
    scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    np.testing.assert_allclose(ours.covariance / scale, theirs / scale, atol=0.01)
    state = ours.state
    np.testing.assert_allclose(state.v, values.atVector(V(2)), atol=2e-3)
    bias = values.atConstantBias(B(2))
    np.testing.assert_allclose(state.gyroscope_bias, bias.gyroscope(), atol=2e-5)
    np.testing.assert_allclose(state.accelerometer_bias, bias.accelerometer(), atol=5e-4)


def _noise(covariance: se3.Array) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _everything(rng: np.random.Generator) -> list[Observation]:
    seen: list[Observation] = []
    for k in range(7, 400, 10):
        seen.append(camera(k, rng.normal(size=6) * np.sqrt(np.diag(CAMERA))))
        if k > 20:
            motion = se3.inverse(TRUTH.T_map_body[k - 10]) @ TRUTH.T_map_body[k]
            stamps = int(TRUTH.stamps_ns[k]) + 3, int(TRUTH.stamps_ns[k - 10]) + 3
            seen.append(RelativeObservation(stamps[0], 'odom', stamps[1], motion, 1e-3 * np.eye(6)))
        twist = np.array([8.0, 0, 0, *TRUTH.turn_rates[k]]) + rng.normal(size=6) * 0.05
        seen.append(TwistObservation(int(TRUTH.stamps_ns[k]), 'wheels', twist, 0.05 * np.eye(6)))
        position = TRUTH.T_map_body[k][:3, 3] + rng.normal(size=3)
        if k % 50 == 7:
            seen.append(PositionObservation(int(TRUTH.stamps_ns[k]), 'gps', position, np.eye(3)))
    # An outlier or two, so that the gate's memory takes part.
    seen[30] = replace(camera(77, np.array([30.0, 0, 0, 0, 0, 0])))
    return [s for i, s in enumerate(seen) if not (i != 30 and s.source == 'camera'
            and s.stamp_ns == seen[30].stamp_ns)]  # fmt: skip


def test_the_order_of_arrival_does_not_matter_to_the_last_bit() -> None:
    """All input delayed at random by up to a second, in any order between and within sources."""
    settings = EkfSettings(
        motion=MOTION,
        start=START,
        constraint=ConstraintConfig(nonholonomic=True),
        gate=GateConfig(recover_after=3),
        history=HistoryConfig(length=2.0),
    )
    seen = _everything(np.random.default_rng(0))
    ordered, shuffled = started(settings), started(settings)
    samples = [(int(TRUTH.stamps_ns[k]), k) for k in range(400)]
    items: list[tuple[int, Observation | int]] = [(stamp, k) for stamp, k in samples]
    items += [(s.stamp_ns, s) for s in seen]

    def put(ekf: VehicleEkf, item: Observation | int) -> None:
        if isinstance(item, int):
            feed(ekf, item, item + 1)
        else:
            ekf.observe(item)

    for _, item in sorted(items, key=lambda pair: pair[0]):
        put(ordered, item)
    rng = np.random.default_rng(1)
    late = [(stamp + rng.integers(0, 1_000_000_000), stamp, item) for stamp, item in items]
    for _, _, item in sorted(late, key=lambda triple: triple[:2]):
        put(shuffled, item)
    a, b = ordered.estimate(), shuffled.estimate()
    assert a is not None and b is not None
    assert shuffled.replayed > 10 * ordered.replayed
    assert a.stamp_ns == b.stamp_ns
    np.testing.assert_array_equal(a.T_map_body, b.T_map_body)
    np.testing.assert_array_equal(a.state.covariance, b.state.covariance)
    np.testing.assert_array_equal(a.state.gyroscope_bias, b.state.gyroscope_bias)
    assert not a.state.clones


def test_two_d_mode_stays_on_the_ground() -> None:
    flat = EkfSettings(motion=MOTION, start=START, constraint=ConstraintConfig(two_d=True))
    ekf = VehicleEkf(flat)
    ekf.start(0, np.eye(4))
    for k in range(500):
        ekf.add_imu(k * 10_000_000, np.array([0, 0, 0.2]), np.array([0.3, 0.0, 9.6]))
    estimate = ekf.estimate()
    assert estimate is not None
    assert abs(estimate.T_map_body[2, 3]) < 0.05
    assert np.arccos(estimate.T_map_body[2, 2]) < 0.02
    assert se3.yaw(estimate.T_map_body) == pytest.approx(1.0, abs=0.02)


def test_wheels_do_not_slide_sideways() -> None:
    def drift(nonholonomic: bool) -> float:
        constraint = ConstraintConfig(nonholonomic=nonholonomic, axle_x=-1.0)
        ekf = VehicleEkf(EkfSettings(motion=MOTION, start=START, constraint=constraint))
        ekf.start(0, np.eye(4), START_POSE, np.array([10.0, 0, 0]))
        for k in range(1000):
            ekf.add_imu(k * 10_000_000, np.zeros(3), np.array([0.0, 0.05, 9.81]))
        estimate = ekf.estimate()
        assert estimate is not None
        return abs(float(estimate.T_map_body[1, 3]))

    assert drift(True) < 0.5 * drift(False)


def test_poses_are_predicted_and_looked_up() -> None:
    ekf = started(
        EkfSettings(motion=MOTION, start=START, history=HistoryConfig(max_prediction=0.5))
    )
    feed(ekf, 0, 101)
    ahead = ekf.estimate(1_050_000_000)
    assert ahead is not None and ahead.stamp_ns == 1_050_000_000
    assert se3.distance(ahead.T_map_body, TRUTH.T_map_body[105])[0] < 0.02
    far = ekf.estimate(9_000_000_000)
    assert far is not None and far.stamp_ns == 1_500_000_000
    past = ekf.estimate(300_000_000)
    assert past is not None
    assert se3.distance(past.T_map_body, TRUTH.T_map_body[30])[0] < 1e-3
    assert ekf.estimate(-5) is None
    assert np.trace(ahead.covariance) > np.trace(past.covariance)


def test_what_cannot_be_used_is_refused_with_the_reason() -> None:
    ekf = VehicleEkf(EkfSettings(motion=MOTION, start=START))
    with pytest.raises(DataError, match='has not started'):
        ekf.observe(camera(0))
    ekf.start(0, TRUTH.T_map_body[0], START_POSE, TRUTH.velocities[0])
    feed(ekf, 0, 400)
    untouched = ekf.estimate()
    bad = camera(390)
    cases: list[tuple[Observation, str]] = [
        (replace(bad, covariance=np.full((6, 6), np.nan)), 'not finite'),
        (replace(bad, covariance=-CAMERA), 'negative variance'),
        (replace(bad, covariance=np.zeros((6, 6))), 'all zero'),
        (replace(bad, covariance=CAMERA + np.triu(np.full((6, 6), 1e-3), 1)), 'not symmetric'),
        (replace(bad, covariance=np.ones((6, 6))), 'not positive definite'),
        (replace(bad, covariance=np.eye(3)), '6 x 6'),
        (replace(bad, T_map_sensor=np.full((4, 4), np.nan)), 'finite numbers'),
        (camera(3), 'late'),
    ]
    for seen, text in cases:
        with pytest.raises(DataError, match=text):
            ekf.observe(seen)
    with pytest.raises(DataError, match='NaN'):
        ekf.add_imu(4_000_000_000, np.array([np.nan, 0, 0]), np.zeros(3))
    with pytest.raises(DataError, match='NaN'):
        ekf.add_imu(4_000_000_000, np.array([np.inf, -np.inf, 0]), np.zeros(3))
    with pytest.raises(DataError, match='repeats'):
        feed(ekf, 399, 400)
    after = ekf.estimate()
    assert untouched is not None and after is not None
    np.testing.assert_array_equal(untouched.state.covariance, after.state.covariance)
    ekf.observe(bad)
    with pytest.raises(DataError, match='repeats'):
        ekf.observe(bad)


def test_samples_from_before_the_start_take_part() -> None:
    early = VehicleEkf(EkfSettings(motion=MOTION, start=START))
    feed(early, 0, 100)
    early.start(0, TRUTH.T_map_body[0], START_POSE, TRUTH.velocities[0])
    late = started()
    feed(late, 0, 100)
    a, b = early.estimate(), late.estimate()
    assert a is not None and b is not None
    np.testing.assert_array_equal(a.T_map_body, b.T_map_body)


def test_a_second_start_keeps_what_is_known_of_the_sensor() -> None:
    ekf = started()
    follow(ekf, 300)
    learnt = ekf.estimate()
    ekf.start(3_000_000_000, np.eye(4))
    again = ekf.estimate()
    assert learnt is not None and again is not None
    np.testing.assert_array_equal(again.state.accelerometer_bias, learnt.state.accelerometer_bias)
    np.testing.assert_allclose(again.T_map_body[:3, 3], 0.0)
    ekf.reset()
    assert not ekf.started and ekf.estimate() is None
