"""Name the topics of a drive: the same in bags, in replay and in the live suite."""

from bags.records import (
    CameraImage,
    GnssFix,
    ImuSample,
    LidarScan,
    Record,
    TruthPose,
    TwistSample,
)

# (topic, message type) of each kind of record.
TOPICS: dict[type[Record], tuple[str, str]] = {
    LidarScan: ('/points', 'sensor_msgs/msg/PointCloud2'),
    CameraImage: ('/camera/image', 'sensor_msgs/msg/Image'),
    ImuSample: ('/imu', 'sensor_msgs/msg/Imu'),
    GnssFix: ('/gps/fix', 'sensor_msgs/msg/NavSatFix'),
    TwistSample: ('/twist', 'geometry_msgs/msg/TwistStamped'),
    TruthPose: ('/ground_truth/pose', 'geometry_msgs/msg/PoseStamped'),
}
CAMERA_INFO_TOPIC = '/camera/camera_info'
TF_STATIC_TOPIC = '/tf_static'

# At equal stamps the sweep comes last, so that all that belongs to its moment is known before it.
ORDER: dict[type[Record], int] = {
    kind: place
    for place, kind in enumerate(
        (ImuSample, TwistSample, GnssFix, TruthPose, CameraImage, LidarScan)
    )
}
