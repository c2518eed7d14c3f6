"""Ball query against brute force, on both of its ways."""

import numpy as np
import pytest
import torch

from lcd_loop_closure.lcdnet import grouping
from lcd_loop_closure.lcdnet.grouping import ball_query


def _scene(seed=0):
    rng = np.random.default_rng(seed)
    points = torch.from_numpy(rng.uniform(-10, 10, (900, 3)).astype(np.float32))
    centres = torch.from_numpy(rng.uniform(-12, 12, (60, 3)).astype(np.float32))
    return points, centres, torch.from_numpy(rng.integers(0, 3, 900)), torch.arange(60) % 3


@pytest.mark.parametrize('way', ['_by_tree', '_by_distances'])
def test_neighbours_are_those_of_brute_force(way, monkeypatch):
    monkeypatch.setattr(grouping, '_by_tree', getattr(grouping, way))
    points, centres, of_points, of_centres = _scene()
    balls = [(2.0, 40), (1.2, 30)]
    found = ball_query(points, centres, balls, points_batch=of_points, centres_batch=of_centres)
    distance = torch.cdist(centres, points)
    for (radius, count), (index, valid) in zip(balls, found, strict=True):
        near = (distance <= radius) & (of_centres[:, None] == of_points[None])
        assert index.shape == valid.shape == (60, count)
        for row in range(60):
            inside = set(torch.nonzero(near[row])[:, 0].tolist())
            assert set(index[row][valid[row]].tolist()) == inside
        assert not valid.all() and valid.any()


def test_balls_searched_at_once_are_those_searched_alone():
    points, centres, of_points, of_centres = _scene()
    balls = [(3.0, 4), (6.0, 8), (1.0, 8)]
    whole = ball_query(points, centres, balls, points_batch=of_points, centres_batch=of_centres)
    for ball, (index, valid) in zip(balls, whole, strict=True):
        alone = ball_query(
            points, centres, [ball], points_batch=of_points, centres_batch=of_centres
        )[0]
        assert torch.equal(index, alone[0]) and torch.equal(valid, alone[1])


def test_crowded_balls_are_sampled_over_their_whole_width():
    rng = np.random.default_rng(1)
    points = torch.from_numpy(rng.uniform(-1, 1, (400, 3)).astype(np.float32))
    one, every = torch.zeros(1, dtype=torch.long), torch.zeros(400, dtype=torch.long)
    centre = torch.zeros(1, 3)
    inside = torch.sort(points.norm(dim=1)).values[:64]
    for generator in (None, np.random.default_rng(0)):
        [(index, valid)] = ball_query(
            points, centre, [(5.0, 16)], points_batch=every, centres_batch=one, generator=generator
        )
        distance = points[index[0]].norm(dim=1)
        assert bool(valid.all()) and len(set(index[0].tolist())) == 16
        assert float(distance[0]) == float(inside[0])  # the nearest is always there
        assert float(distance.max()) > float(inside[50])


def test_an_empty_ball_and_an_empty_cloud_say_so():
    points, centres, of_points, of_centres = _scene()
    far = centres + 1000.0
    ball = [(1.0, 4)]
    [(_, valid)] = ball_query(points, far, ball, points_batch=of_points, centres_batch=of_centres)
    assert not valid.any()
    [(index, valid)] = ball_query(
        points[:0], centres, ball, points_batch=of_points[:0], centres_batch=of_centres
    )
    assert index.shape == (60, 4) and not valid.any()
