"""Nothing stands where the car drives, whatever the route."""

import numpy as np
import pytest

from bags.street import LidarConfig, Route, StreetConfig, StreetDrive
from bags.street.drive import T_BASE_LIDAR
from lcd_common import se3

ZIGZAG = Route().through([(0, 0), (50, 10), (60, 60), (110, 40), (150, 90)])


@pytest.mark.parametrize(('route', 'seed'), [('loop', 0), ('abrupt_u_turn', 3), (ZIGZAG, 7)])
def test_the_driven_lane_is_free(route: Route | str, seed: int) -> None:
    lidar = LidarConfig(columns=180, range_noise=0.0, dropout=0.0, min_range=0.1)
    drive = StreetDrive(route, StreetConfig(seed=seed), lidar)
    poses = drive.truth().T_world_body
    for index in range(0, len(poses), 25):
        world = se3.transform_points(
            poses[index] @ T_BASE_LIDAR, drive.scan(index).cloud.xyz.astype(float)
        )
        above = world[:, 2] - drive.ground.height(world[:, :2])
        upright = world[(above > 0.4) & (above < 2.0)]
        for T in poses[index : index + 25 : 5]:
            body = se3.transform_points(se3.inverse(T), upright)
            assert not np.any((np.abs(body[:, 0]) < 2.0) & (np.abs(body[:, 1]) < 0.9))


def test_a_town_has_walls_on_both_sides() -> None:
    drive = StreetDrive('loop', lidar=LidarConfig(columns=360))
    for index in range(50, 650, 100):
        xyz = drive.scan(index).cloud.xyz
        tall = xyz[xyz[:, 2] > -0.5]
        assert (tall[:, 1] > 3).sum() > 100 and (tall[:, 1] < -3).sum() > 100
