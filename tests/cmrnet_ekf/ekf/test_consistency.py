"""Is the filter as wrong as it says? And does the measure notice when it is not?"""

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks import ekf_consistency
from benchmarks.camera_errors import CameraErrors
from benchmarks.ekf_drive import reference_drive
from cmrnet_ekf.ekf.consistency import anees, anees_band, autocorrelation, nees
from lcd_common import se3


def test_the_band_is_that_of_the_textbook() -> None:
    low, high = anees_band(50, 6)
    assert (round(low, 2), round(high, 2)) == (5.08, 7.00)


def test_nees_of_errors_drawn_from_the_covariance_is_chi_square() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * 0.02
    covariance = root @ root.T + 1e-5 * np.eye(6)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=4000)
    T = se3.exp([3.0, 2.0, 1.0, 0.1, 0.2, 2.0])
    values = np.array([nees(T, covariance, T @ se3.exp(xi)) for xi in errors])
    assert values.mean() == pytest.approx(6.0, abs=0.15)
    for share in (0.1, 0.5, 0.9):
        assert np.mean(values < chi2.ppf(share, 6)) == pytest.approx(share, abs=0.03)


def test_anees_counts_epochs_inside_the_band() -> None:
    values = np.array([[6.0, 20.0], [6.0, 20.0]])
    result = anees(values)
    assert result.inside_share == 0.5 and result.mean == 13.0


@pytest.mark.parametrize('a', [0.0, 0.7])
def test_autocorrelation_of_a_process_of_first_order(a: float) -> None:
    rng = np.random.default_rng(0)
    x = np.zeros((5000, 2))
    for k in range(1, len(x)):
        x[k] = a * x[k - 1] + rng.normal(size=2)
    assert autocorrelation([x]) == pytest.approx(a, abs=0.03)
    assert autocorrelation([x], lag=3) == pytest.approx(a**3, abs=0.05)


def _mean_nees(runs: int, camera: CameraErrors | None = None) -> float:
    drive = reference_drive(5.0)
    records = [ekf_consistency.run_once(drive, seed, camera) for seed in range(runs)]
    return float(np.mean([record.nees for record in records]))


def test_the_filter_is_as_wrong_as_it_says() -> None:
    assert 4.8 < _mean_nees(10) < 7.2


def test_a_camera_that_is_too_sure_is_noticed() -> None:
    """Errors that are twice as large as the covariances that come with them."""
    sigmas = ekf_consistency.CAMERA_SIGMAS
    xi = np.random.default_rng(0).normal(size=(1, 500, 6)) * 2 * sigmas
    covariances = np.tile(np.diag(sigmas**2), (1, 500, 1, 1))
    assert _mean_nees(4, CameraErrors(xi, covariances, np.ones((1, 500)))) > 10.0


def test_errors_that_last_need_to_be_told() -> None:
    """A camera that is off by the same amount for eight seconds, a different one in each run."""
    sigmas = ekf_consistency.CAMERA_SIGMAS
    xi = np.repeat(np.random.default_rng(0).normal(size=(4, 1, 6)) * sigmas, 40, axis=1)
    covariances = np.tile(np.diag(sigmas**2), (4, 40, 1, 1))
    camera = CameraErrors(xi, covariances, np.ones((4, 40)))
    found = ekf_consistency.with_real_errors(camera, 4, correlation_s=4.0)
    assert found['as_told']['anees_mean'] < 0.5 * found['independent']['anees_mean']
    assert found['as_told']['seconds'] == found['independent']['seconds'] == 4.0


def test_the_order_of_arrival_does_not_matter() -> None:
    assert ekf_consistency.order_invariance(3.0)['order_difference'] == 0.0


def test_the_drive_is_what_its_samples_say() -> None:
    """Integrating the samples gives the poses: the benchmark's truth is a truth."""
    drive = reference_drive(5.0)
    state_at = ekf_consistency.begun(drive, np.random.default_rng(0), ekf_consistency.settings())
    state_at.start(int(drive.stamps_ns[0]), drive.T_map_body[0], None, drive.velocities[0])
    for k, stamp_ns in enumerate(drive.stamps_ns.tolist()):
        state_at.add_imu(stamp_ns, drive.turn_rates[k], drive.forces[k])
    estimate = state_at.estimate()
    assert estimate is not None
    metres, radians = se3.distance(estimate.T_map_body, drive.T_map_body[-1])
    assert metres < 2e-3 and radians < 1e-9
