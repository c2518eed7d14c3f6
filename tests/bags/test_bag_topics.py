"""Which topics of a bag are read as what."""

import pytest

from bags.bag_source import BagTopic
from bags.bag_topics import TYPES, choose_topics
from lcd_common.errors import DataError


def topics(*names_and_types: tuple[str, str]) -> list[BagTopic]:
    return [BagTopic(name, f'{kind.replace("/", "/msg/")}', 5) for name, kind in names_and_types]


VELODYNE = ('/velodyne_points', 'sensor_msgs/PointCloud2')
OUSTER = ('/ouster/points', 'sensor_msgs/PointCloud2')
OWN = ('/points', 'sensor_msgs/PointCloud2')
IMU_A, IMU_B = ('/imu/data', 'sensor_msgs/Imu'), ('/imu/raw', 'sensor_msgs/Imu')
ODOM = ('/odom', 'nav_msgs/Odometry')
POSE = ('/pose', 'geometry_msgs/PoseStamped')
TRUTH = ('/ground_truth/pose', 'geometry_msgs/PoseStamped')


def chosen(available, wanted=None):
    found = choose_topics('x.mcap', topics(*available), wanted or {})
    return {role: topic.name for role, topic in found.items()}


def test_the_only_topic_of_a_type_is_taken():
    assert chosen([VELODYNE, IMU_A]) == {'points': '/velodyne_points', 'imu': '/imu/data'}


def test_the_suites_own_name_wins():
    assert chosen([VELODYNE, OWN, OUSTER])['points'] == '/points'


def test_several_clouds_are_an_error_that_lists_them():
    with pytest.raises(
        DataError, match='could be points: /velodyne_points, /ouster/points; choose'
    ):
        chosen([VELODYNE, OUSTER])
    assert chosen([VELODYNE, OUSTER], {'points': '/ouster/points'})['points'] == '/ouster/points'


def test_several_topics_of_another_role_are_left_out_with_a_warning(caplog):
    assert chosen([VELODYNE, IMU_A, IMU_B]) == {'points': '/velodyne_points'}
    assert 'several topics could be imu: /imu/data, /imu/raw; choose with imu=TOPIC' in caplog.text


def test_an_empty_name_leaves_a_role_out():
    assert chosen([VELODYNE, IMU_A], {'imu': ''}) == {'points': '/velodyne_points'}


def test_poses_and_odometry_are_truth_or_twist_only_by_name():
    assert chosen([VELODYNE, POSE, ODOM]) == {'points': '/velodyne_points'}
    assert chosen([VELODYNE, POSE, TRUTH])['truth'] == '/ground_truth/pose'
    wanted = {'truth': '/odom', 'twist': '/odom'}
    assert chosen([ODOM], wanted) == wanted


def test_topics_that_are_absent_or_of_another_type_are_errors():
    with pytest.raises(DataError, match=r'/nope for points is not in the bag.*: /velodyne_points'):
        chosen([VELODYNE], {'points': '/nope'})
    with pytest.raises(DataError, match=r'/imu/data for points is a sensor_msgs/msg/Imu, not a'):
        chosen([IMU_A], {'points': '/imu/data'})


def test_unknown_role_is_an_error_that_lists_the_known():
    with pytest.raises(DataError, match=f'unknown role lidar.*{", ".join(TYPES)}'):
        chosen([VELODYNE], {'lidar': '/velodyne_points'})


def test_topics_without_messages_do_not_count():
    empty = BagTopic('/empty', 'sensor_msgs/msg/PointCloud2', 0)
    assert choose_topics('x', [empty, *topics(OUSTER)], {})['points'].name == '/ouster/points'
