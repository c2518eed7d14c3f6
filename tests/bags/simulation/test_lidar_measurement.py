"""Noise, losses and edges of a sweep follow the sensor's figures."""

from dataclasses import replace

import numpy as np
import pytest

from bags.simulation.lidar_measurement import (
    Echoes,
    Surfaces,
    beam_errors,
    calibrated_directions,
    draw,
    measure,
    neighbours,
)
from bags.simulation.lidar_model import LidarModel, lidar_model

HDL64 = lidar_model('hdl64')
FAULTLESS = replace(HDL64, range_sigma_m=0.0, beam_sigma_m=0.0, range_step_m=0.0, dropout=0.0)


def surfaces(range_m: object, incidence: float = 1.0, reflectivity: float = 0.6) -> Surfaces:
    shape = (HDL64.columns, 64)
    full = [
        np.broadcast_to(np.asarray(values, np.float32), shape)
        for values in (range_m, incidence, reflectivity, 1.0)
    ]
    return Surfaces(*full)


def measured(seen: Surfaces, model: LidarModel, seed: int = 0) -> Echoes:
    rng = np.random.default_rng(seed)
    shape = (model.columns, 64)
    near = neighbours(model, rng.random(shape, np.float32))
    return measure(seen, near, draw(rng, shape), model, beam_errors(model, 7))


def test_range_noise_is_that_of_the_model() -> None:
    range_m = measured(surfaces(20.0), replace(HDL64, range_step_m=0.0)).range_m
    error = np.where(np.isfinite(range_m), range_m - 20.0, np.nan)
    per_beam = np.nanmean(error, axis=0)
    np.testing.assert_allclose(per_beam, beam_errors(HDL64, 7), atol=4 * 0.02 / 43)
    assert np.nanstd(error - per_beam) == pytest.approx(0.02, rel=0.02)


def test_beams_of_another_sensor_err_otherwise() -> None:
    errors = np.array([beam_errors(HDL64, seed) for seed in range(200)])
    assert errors.std() == pytest.approx(HDL64.beam_sigma_m, rel=0.05)
    assert not np.array_equal(errors[0], errors[1])


def test_the_calibration_almost_says_where_beams_point() -> None:
    kitti = lidar_model('hdl64_kitti')
    said = np.array([calibrated_directions(kitti, seed)[::200] for seed in range(60)], np.float64)
    angle = kitti.elevation_rad - np.arcsin(said[..., 2])
    assert angle.std() == pytest.approx(kitti.angle_sigma_rad, rel=0.05)
    assert angle.mean() == pytest.approx(kitti.elevation_bias_rad, rel=0.05)
    azimuth = np.arctan2(said[..., 1], said[..., 0]) - kitti.azimuth_rad()[::200, None]
    assert np.angle(np.exp(1j * azimuth)).std() == pytest.approx(kitti.angle_sigma_rad, rel=0.05)
    np.testing.assert_allclose(np.linalg.norm(said, axis=-1), 1.0, atol=1e-6)
    ideal = calibrated_directions(replace(HDL64, angle_sigma_rad=0.0), 1)
    np.testing.assert_allclose(ideal, HDL64.directions(), atol=1e-6)


def test_ranges_are_quantised() -> None:
    range_m = measured(surfaces(20.0), HDL64).range_m
    steps = range_m[np.isfinite(range_m)].astype(np.float64) / HDL64.range_step_m
    assert np.abs(steps - np.round(steps)).max() < 0.01


def test_half_of_a_dark_reflectors_returns_are_lost_at_the_reach() -> None:
    far = surfaces(HDL64.reach_m, reflectivity=0.1)
    returned = np.isfinite(measured(far, FAULTLESS).range_m)
    assert returned.mean() == pytest.approx(0.5, abs=0.006)


def test_dropout_and_material_lose_their_shares() -> None:
    model = replace(FAULTLESS, dropout=0.07)
    near = surfaces(5.0)
    assert np.isfinite(measured(near, model).range_m).mean() == pytest.approx(0.93, abs=0.004)
    glass = replace(near, return_share=np.full_like(near.range_m, 0.35))
    assert np.isfinite(measured(glass, FAULTLESS).range_m).mean() == pytest.approx(0.35, abs=0.006)


def test_grazing_surfaces_and_far_ones_return_less_and_darker() -> None:
    def share_and_intensity(range_m: float, incidence: float) -> tuple[float, float]:
        echoes = measured(surfaces(range_m, incidence, 0.15), FAULTLESS)
        returned = np.isfinite(echoes.range_m)
        return returned.mean(), echoes.intensity[returned].mean()

    near, far, grazing = (
        share_and_intensity(*case) for case in ((10.0, 1.0), (60.0, 1.0), (10.0, 0.1))
    )
    assert near[0] > far[0] + 0.1
    assert near[1] == pytest.approx(0.15, abs=0.005)
    assert near[1] == pytest.approx(far[1], abs=0.005)  # intensity is corrected for the range
    # Asphalt at grazing angles is still well seen: 0.6 of its brightness and Lambert's rest.
    assert grazing[1] == pytest.approx((0.6 + 0.4 * 0.1) * 0.15, abs=0.005)


def test_nothing_hit_is_nothing_measured_and_limits_hold() -> None:
    assert not np.isfinite(measured(surfaces(np.inf), HDL64).range_m).any()
    assert not np.isfinite(measured(surfaces(0.5), HDL64).range_m).any()
    assert not np.isfinite(measured(surfaces(130.0, reflectivity=1.0), FAULTLESS).range_m).any()


def halves(near_m: float, far_m: float) -> Surfaces:
    """Return what a post of half the circle before a wall looks like."""
    column = np.where(np.arange(HDL64.columns) < HDL64.columns // 2, near_m, far_m)
    return surfaces(column[:, None])


def test_beams_over_an_edge_see_one_side_or_the_other() -> None:
    range_m = np.concatenate([measured(halves(8.0, 12.0), FAULTLESS, s).range_m for s in range(40)])
    range_m = range_m.reshape(40, HDL64.columns, 64)
    away_from_edges = [HDL64.columns // 4, 3 * HDL64.columns // 4]
    assert set(np.round(np.unique(range_m[:, away_from_edges]), 3)) <= {8.0, 12.0, np.inf}
    beside = range_m[:, HDL64.columns // 2]  # the wall's first column
    assert set(np.round(np.unique(beside), 3)) <= {8.0, 12.0, np.inf}
    # The rim of the beam meets the post with (divergence / 2) / spacing; the nearer post sends more
    # back per share, (12 / 8)^2 = 2.25, so it wins from a share of 1 / 3.25 on.
    spacing = 2 * np.pi / HDL64.columns * np.cos(HDL64.elevation_rad)
    # Four neighbours share the beam: none gets more than a quarter.
    meets = np.minimum(0.25, 0.5 * HDL64.divergence_rad / spacing)
    expected = meets * (0.5 - 1 / 3.25) / 0.5
    assert np.mean(np.isclose(beside, 8.0)) == pytest.approx(expected.mean(), abs=0.03)


def test_beams_over_a_small_step_mix_both_ranges() -> None:
    range_m = np.concatenate([measured(halves(8.0, 8.6), FAULTLESS, s).range_m for s in range(9)])
    beside = range_m.reshape(9, HDL64.columns, 64)[:, HDL64.columns // 2]
    mixed = beside[(beside > 8.01) & (beside < 8.59)]
    assert 0.1 < len(mixed) / beside.size < 0.45


def test_a_slanted_surface_is_no_edge() -> None:
    """Rings of a flat road lie metres apart far away; still each beam sees road alone."""
    down = np.maximum(1e-9, -np.sin(HDL64.elevation_rad))
    range_m = np.where(HDL64.elevation_rad < -0.03, 1.73 / down, np.inf)
    seen = surfaces(range_m, reflectivity=0.5)
    seen = replace(seen, incidence=np.broadcast_to(down.astype(np.float32), seen.range_m.shape))
    below = HDL64.elevation_rad < -0.04
    echoes = measured(seen, FAULTLESS)
    with np.errstate(invalid='ignore'):
        error = (echoes.range_m - range_m)[:, below]
    assert np.abs(error[np.isfinite(error)]).max() < 1e-3


@pytest.mark.parametrize('behind_m', [8.6, 12.0])  # the echoes melt into one, or are two
def test_torch_measures_the_same(behind_m: float) -> None:
    torch = pytest.importorskip('torch')
    rng = np.random.default_rng(3)
    seen = halves(8.0, behind_m)
    near = neighbours(HDL64, rng.random(seen.range_m.shape, np.float32))
    draws, error = draw(rng, seen.range_m.shape, dual=True), beam_errors(HDL64, 7)
    stronger = measure(seen, near, draws, HDL64, error)

    def tensors(values: object) -> object:
        if values is None or isinstance(values, np.ndarray):
            return None if values is None else torch.from_numpy(np.array(values))
        return type(values)(**{k: tensors(v) for k, v in vars(values).items()})

    by_torch = measure(
        tensors(seen), tensors(near), tensors(draws), HDL64, torch.from_numpy(error), torch
    )
    both_weaker = (stronger.weaker, by_torch.weaker)
    assert np.isfinite(both_weaker[0].range_m).any() == (behind_m > 10.0)
    for ours, theirs in ((stronger, by_torch), both_weaker):
        same = np.isfinite(ours.range_m) == np.isfinite(theirs.range_m.numpy())
        assert same.mean() > 0.9999
        both = np.isfinite(ours.range_m) & same
        difference = ours.range_m[both] - theirs.range_m.numpy()[both]
        assert np.abs(difference).max(initial=0.0) <= 0.0021
