"""Poses between sweeps are those of a polynomial, and the remainder is told."""

from itertools import pairwise

import numpy as np
import pytest

from lcd_common import se3
from lcd_loop_closure.unsteady_motion import UnsteadyMotion


def along_x(metres: float) -> np.ndarray:
    return np.array([metres, 0, 0, 0, 0, 0.0])


@pytest.mark.parametrize('share', [-0.5, 0.0, 0.5, 1.0])
def test_the_way_to_the_stamp_is_exact_for_a_constant_acceleration(share: float) -> None:
    def x(step: float) -> float:
        return 3.0 + 0.9 * step + 0.04 * step**2

    motion, before = x(7) - x(6), x(6) - x(5)
    unsteady = UnsteadyMotion()
    unsteady.take(np.zeros(6), steady=True)
    T = unsteady.to_stamp(share, along_x(motion), along_x(motion - before))
    assert T[0, 3] == pytest.approx(x(7 - share) - x(7), abs=1e-12)
    now = unsteady.at_middle(along_x(motion), along_x(motion - before))
    assert now[0] == pytest.approx(0.9 + 2 * 0.04 * 7)


def test_an_unknown_acceleration_is_left_out() -> None:
    unsteady = UnsteadyMotion()
    T = unsteady.to_stamp(0.5, along_x(1.0), along_x(0.2))
    np.testing.assert_allclose(se3.log(T), along_x(-0.5))
    np.testing.assert_array_equal(unsteady.at_middle(along_x(1.0), along_x(0.2)), along_x(1.0))


@pytest.mark.parametrize('share', [-0.5, 0.5])
def test_the_remainder_of_a_changing_acceleration_is_in_the_covariance(share: float) -> None:
    def x(step: float) -> float:
        return 0.02 * step**3

    steps = [x(k) - x(k - 1) for k in range(1, 12)]
    unsteady = UnsteadyMotion()
    unsteady.take(np.zeros(6), steady=True)
    for before, motion in pairwise(steps):
        covariance = unsteady.covariance(along_x(motion - before), share)
        unsteady.take(along_x(motion - before), steady=True)
    T = unsteady.to_stamp(share, along_x(steps[-1]), along_x(steps[-1] - steps[-2]))
    error = T[0, 3] - (x(11 - share) - x(11))
    assert abs(error) > 0.005
    assert error**2 < covariance[0, 0] < 100 * error**2
    np.testing.assert_array_equal(covariance[1:, 1:], 0.0)


def test_a_lost_motion_makes_the_next_step_unsure_too() -> None:
    unsteady = UnsteadyMotion()
    unsteady.lose(np.eye(6), 0.5)
    assert unsteady.covariance(np.zeros(6), 0.5)[0, 0] == pytest.approx(0.25)
    assert unsteady.covariance(np.zeros(6), 0.5)[0, 0] == pytest.approx(0.0)
