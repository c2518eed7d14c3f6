"""Write small drives in the published layouts, and bags with rosbags' own writers."""

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

sys.path.append(str(Path(__file__).parent))

# Real numbers of KITTI 00: the colour camera is not where camera 0 is.
P0 = '718.856 0 607.1928 0 0 718.856 185.2157 0 0 0 1 0'
P2 = '718.856 0 607.1928 45.38225 0 718.856 185.2157 -0.1130887 0 0 1 0.003779761'
TR = (
    '4.276802385584e-04 -9.999672484946e-01 -8.084491683471e-03 -1.198459927713e-02 '
    '-7.210626507497e-03 8.081198471645e-03 -9.999413164504e-01 -5.403984729748e-02 '
    '9.999738645903e-01 4.859485810390e-04 -7.206933692422e-03 -2.921968648686e-01'
)


def points(number: int, count: int = 50) -> np.ndarray:
    """Return points [count x 4] float32 that differ from scan to scan."""
    return np.random.default_rng(number).normal(size=(count, 4)).astype(np.float32)


@pytest.fixture
def points_of() -> Callable[..., np.ndarray]:
    return points


@pytest.fixture
def write_image() -> Callable[..., None]:
    """Write a picture of one colour; `color` may be an int (grey) or three."""

    def write(path: Path, color: Any = (10, 20, 30), size: tuple[int, int] = (12, 8)) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new('L' if isinstance(color, int) else 'RGB', size, color).save(path)

    return write


@pytest.fixture
def kitti(tmp_path: Path, write_image: Callable[..., None]) -> Callable[..., Path]:
    """Write a KITTI odometry root; returns the sequence's folder."""

    def make(
        numbers: Iterable[int] = range(5),
        times: list[float] | None = None,
        poses: int | None = None,
        images: Iterable[int] = (),
        sequence: str = '00',
    ) -> Path:
        numbers = list(numbers)
        folder = tmp_path / 'sequences' / sequence
        (folder / 'velodyne').mkdir(parents=True)
        for number in numbers:
            points(number).tofile(folder / 'velodyne' / f'{number:06d}.bin')
        times = [0.1 * n for n in range(max(numbers) + 1)] if times is None else times
        (folder / 'times.txt').write_text(''.join(f'{t:.6e}\n' for t in times))
        (folder / 'calib.txt').write_text(f'P0: {P0}\nP2: {P2}\nTr: {TR}\n')
        rows = [
            [1, 0, 0, 0.1 * n, 0, 1, 0, 0, 0, 0, 1, 1.0 * n]
            for n in range(len(times) if poses is None else poses)
        ]
        if rows:
            (tmp_path / 'poses').mkdir(exist_ok=True)
            np.savetxt(tmp_path / 'poses' / f'{sequence}.txt', rows)
        for number in images:
            write_image(folder / 'image_2' / f'{number:06d}.png')
        return folder

    return make


class BagMaker:
    """Build messages and write them to a bag with rosbags."""

    def __init__(self, folder: Path, ros1: bool = False) -> None:
        self.folder = folder
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        if ros1:
            definition = 'geometry_msgs/TransformStamped[] transforms'
            self.store.register(get_types_from_msg(definition, 'tf2_msgs/msg/TFMessage'))
        self.messages: list[tuple[str, int, Any]] = []

    def type(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, stamp_ns: int, frame: str) -> Any:
        time = self.type('builtin_interfaces/msg/Time')(*divmod(stamp_ns, 1_000_000_000))
        header = self.type('std_msgs/msg/Header')
        return header(0, time, frame) if self.ros1 else header(time, frame)

    def add(self, topic: str, message: Any, log_ns: int) -> None:
        self.messages.append((topic, log_ns, message))

    def cloud(
        self,
        stamp_ns: int,
        xyzi: np.ndarray,
        topic: str = '/points',
        names: str = 'xyzi',
        log_ns: int | None = None,
    ) -> None:
        field = self.type('sensor_msgs/msg/PointField')
        fields = [
            field({'i': 'intensity'}.get(name, name), 4 * n, 7, 1) for n, name in enumerate(names)
        ]
        data = np.ascontiguousarray(xyzi, dtype=np.float32).view(np.uint8).reshape(-1)
        step = 4 * len(names)
        message = self.type('sensor_msgs/msg/PointCloud2')(
            self.header(stamp_ns, 'velodyne'),
            1,
            len(data) // step,
            fields,
            False,
            step,
            len(data),
            data,
            True,
        )
        self.add(topic, message, stamp_ns if log_ns is None else log_ns)

    def image(
        self,
        stamp_ns: int,
        pixels: np.ndarray,
        encoding: str,
        topic: str = '/camera/image',
        log_ns: int | None = None,
    ) -> None:
        height, width = pixels.shape[:2]
        message = self.type('sensor_msgs/msg/Image')(
            self.header(stamp_ns, 'camera'),
            height,
            width,
            encoding,
            0,
            pixels[0].nbytes,
            np.ascontiguousarray(pixels).view(np.uint8).reshape(-1),
        )
        self.add(topic, message, stamp_ns if log_ns is None else log_ns)

    def vector(self, values: Iterable[float]) -> Any:
        return self.type('geometry_msgs/msg/Vector3')(*map(float, values))

    def quaternion(self, values: Iterable[float]) -> Any:
        return self.type('geometry_msgs/msg/Quaternion')(*map(float, values))

    def imu(self, stamp_ns: int, value: float, topic: str = '/imu') -> None:
        message = self.type('sensor_msgs/msg/Imu')(
            self.header(stamp_ns, 'imu'),
            self.quaternion([0, 0, 0, 1]),
            np.zeros(9),
            self.vector([value, 0, 0]),
            np.zeros(9),
            self.vector([0, value, 9.81]),
            np.zeros(9),
        )
        self.add(topic, message, stamp_ns)

    def fix(self, stamp_ns: int, latitude: float, status: int = 0) -> None:
        message = self.type('sensor_msgs/msg/NavSatFix')(
            self.header(stamp_ns, 'gps'),
            self.type('sensor_msgs/msg/NavSatStatus')(status, 1),
            latitude,
            8.4,
            116.0,
            np.diag([1.0, 2.0, 3.0]).ravel(),
            2,
        )
        self.add('/gps/fix', message, stamp_ns)

    def pose(self, stamp_ns: int, x: float, topic: str = '/ground_truth/pose') -> None:
        pose = self.type('geometry_msgs/msg/Pose')(
            self.type('geometry_msgs/msg/Point')(float(x), 0.0, 0.0),
            self.quaternion([0, 0, 0, 1]),
        )
        message = self.type('geometry_msgs/msg/PoseStamped')(self.header(stamp_ns, 'world'), pose)
        self.add(topic, message, stamp_ns)

    def mounting(self, log_ns: int, child: str, z: float) -> None:
        transform = self.type('geometry_msgs/msg/Transform')(
            self.vector([0, 0, z]), self.quaternion([0, 0, 0, 1])
        )
        stamped = self.type('geometry_msgs/msg/TransformStamped')(
            self.header(log_ns, 'base_link'), child, transform
        )
        self.add('/tf_static', self.type('tf2_msgs/msg/TFMessage')([stamped]), log_ns)

    def write(self, storage: str = 'mcap', name: str = 'bag', compress: bool = True) -> Path:
        """Write rosbag2 as mcap or sqlite3, or rosbag1 (`storage` is then without meaning)."""
        path = self.folder / (f'{name}.bag' if self.ros1 else name)
        if self.ros1:
            writer: Any = Rosbag1Writer(path)
        else:
            plugin = StoragePlugin.MCAP if storage == 'mcap' else StoragePlugin.SQLITE3
            writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
            if storage == 'mcap' and compress:
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connections: dict[str, Any] = {}
            for topic, log_ns, message in self.messages:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                encode = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
                writer.write(connections[topic], log_ns, encode(message, kind))
        return path


@pytest.fixture
def bag(tmp_path: Path) -> BagMaker:
    return BagMaker(tmp_path)


@pytest.fixture
def bag1(tmp_path: Path) -> BagMaker:
    return BagMaker(tmp_path, ros1=True)
