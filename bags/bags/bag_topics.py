"""Choose which topics of a bag are read as what."""

import logging
from collections.abc import Mapping, Sequence

from bags.bag_source import BagTopic
from lcd_common.errors import DataError

_log = logging.getLogger(__name__)

# Message types that a role can be read from; the first ones are also taken without being asked for.
TYPES: dict[str, tuple[str, ...]] = {
    'points': ('sensor_msgs/msg/PointCloud2',),
    'image': ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'),
    'camera_info': ('sensor_msgs/msg/CameraInfo',),
    'imu': ('sensor_msgs/msg/Imu',),
    'gnss': ('sensor_msgs/msg/NavSatFix',),
    'twist': (
        'geometry_msgs/msg/TwistStamped',
        'geometry_msgs/msg/TwistWithCovarianceStamped',
        'nav_msgs/msg/Odometry',
    ),
    'truth': (
        'geometry_msgs/msg/PoseStamped',
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        'geometry_msgs/msg/TransformStamped',
        'nav_msgs/msg/Odometry',
    ),
}
# The suite's own names win where several topics would do.
OWN_NAMES = {
    'points': '/points',
    'image': '/camera/image',
    'camera_info': '/camera/camera_info',
    'imu': '/imu',
    'gnss': '/gps/fix',
    'twist': '/twist',
    'truth': '/ground_truth/pose',
}


def choose_topics(
    path: str, available: Sequence[BagTopic], wanted: Mapping[str, str]
) -> dict[str, BagTopic]:
    """Return the topic of each role that the bag can serve.

    A role is taken from the topic asked for, else from the suite's own name for it, else from the
    only topic of its type. An empty name leaves a role out. A pose is ground truth only under the
    suite's own name or when asked for. Several candidates for the points are an error; for other
    roles they are left out with a warning.

    Args:
        path: the bag, for messages.
        available: the topics of the bag.
        wanted: role to topic, e.g. {'points': '/velodyne_points', 'imu': ''}.

    Raises:
        DataError: a role is unknown, a topic is absent or of the wrong type, or the points cannot
            be told.
    """
    unknown = sorted(set(wanted) - set(TYPES))
    if unknown:
        raise DataError(
            f'unknown role {", ".join(unknown)}; topics have the roles {", ".join(TYPES)}'
        )
    chosen: dict[str, BagTopic] = {}
    for role in TYPES:
        topic = _choose(path, role, available, wanted)
        if topic is not None:
            chosen[role] = topic
    return chosen


def _choose(
    path: str, role: str, available: Sequence[BagTopic], wanted: Mapping[str, str]
) -> BagTopic | None:
    fitting = [t for t in available if t.type_name in TYPES[role] and t.count]
    if role in wanted:
        return _asked_for(path, role, wanted[role], available) if wanted[role] else None
    own = [t for t in fitting if t.name == OWN_NAMES[role]]
    if own:
        return own[0]
    if role == 'truth':
        return None
    if role == 'twist':
        fitting = [t for t in fitting if t.type_name == TYPES['twist'][0]]
    if len(fitting) > 1:
        names = ', '.join(t.name for t in fitting)
        message = f'{path}: several topics could be {role}: {names}; choose with {role}=TOPIC'
        if role == 'points':
            raise DataError(message)
        _log.warning('%s; left out', message)
    return fitting[0] if len(fitting) == 1 else None


def _asked_for(path: str, role: str, name: str, available: Sequence[BagTopic]) -> BagTopic:
    found = [t for t in available if t.name == name]
    fitting = [t for t in found if t.type_name in TYPES[role]]
    if fitting:
        return fitting[0]
    types = ' or '.join(TYPES[role])
    others = ', '.join(t.name for t in available if t.type_name in TYPES[role]) or 'none'
    what = f'is a {found[0].type_name}, not a {types}' if found else 'is not in the bag'
    raise DataError(f'{path}: the topic {name} for {role} {what}; topics of that type: {others}')
