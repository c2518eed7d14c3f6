"""Read the OXTS RT3003 packets of KITTI's raw recordings.

Which values become what, and why: the unit is an INS whose attitude and velocity are filtered with
GNSS. The IMU record takes the body-axes ax ay az and wx wy wz, the rawest there is (af … wu are the
same turned level with the filtered attitude). The twist record is the filtered velocity: good as a
wheel odometer's stand-in or as reference, not as an independent measurement beside the GNSS fix.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.numbered_files import numbered_files
from bags.records import GnssFix, ImuSample, Record, TwistSample
from bags.sensor_stream import SensorStream, make_stream
from bags.skips import Skips
from bags.stamp_files import read_date_stamps, stamps_of_numbers
from lcd_common import se3
from lcd_common.trajectory import Trajectory

_FIELDS = 30
_LAT, _LON, _ALT, _ROLL, _PITCH, _YAW = range(6)
_LEVEL_VELOCITY = slice(8, 11)  # vf vl vu
_ACCELERATION = slice(11, 14)  # ax ay az
_ANGULAR_RATE = slice(17, 20)  # wx wy wz
_POSITION_ACCURACY = 23
_EARTH_RADIUS_M = 6378137.0


@dataclass(frozen=True)
class OxtsLog:
    """All packets of a drive: stamps [N] increasing, packets [N x 30] in KITTI's field order."""

    source: str
    stamps_ns: NDArray[np.int64]
    packets: NDArray[np.float64]

    def streams(self, skips: Skips) -> list[SensorStream]:
        """Return the streams of IMU, GNSS and twist records."""
        rows = np.arange(len(self.stamps_ns))
        return [
            make_stream(kind, self.source, self.stamps_ns, rows, read, skips)
            for kind, read in (
                (ImuSample, self._imu),
                (GnssFix, self._fix),
                (TwistSample, self._twist),
            )
        ]

    def trajectory(self, T_imu_body: se3.Array) -> Trajectory:
        """Return the INS's poses of a body, in east-north-up axes at the first position.

        Positions are projected as KITTI's development kit does it: Mercator, scaled at the first
        latitude.
        """
        latitude, longitude = self.packets[:, _LAT], self.packets[:, _LON]
        scale = np.cos(np.radians(latitude[0])) * _EARTH_RADIUS_M
        east = scale * np.radians(longitude)
        north = scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
        position = np.stack([east, north, self.packets[:, _ALT]], axis=1)
        poses = np.tile(np.eye(4), (len(position), 1, 1))
        for pose, packet in zip(poses, self.packets, strict=True):
            pose[:3, :3] = _attitude(packet)
        poses[:, :3, 3] = position - position[0]
        bodies = poses @ T_imu_body
        bodies[:, :3, 3] -= bodies[0, :3, 3]
        return Trajectory(self.stamps_ns, bodies)

    def _imu(self, entry: int, stamp_ns: int) -> Record:
        packet = self.packets[entry]
        return ImuSample(stamp_ns, packet[_ANGULAR_RATE].copy(), packet[_ACCELERATION].copy())

    def _fix(self, entry: int, stamp_ns: int) -> Record:
        packet = self.packets[entry]
        accuracy = float(packet[_POSITION_ACCURACY])
        # The unit states its accuracy for north and east alone; up is taken as twice as bad, which
        # is usual for GNSS, so that no consumer trusts the height more than the position.
        covariance = np.diag([1.0, 1.0, 4.0]) * accuracy**2 if accuracy > 0 else None
        return GnssFix(
            stamp_ns,
            float(packet[_LAT]),
            float(packet[_LON]),
            float(packet[_ALT]),
            covariance,
        )

    def _twist(self, entry: int, stamp_ns: int) -> Record:
        packet = self.packets[entry]
        roll, pitch = packet[_ROLL], packet[_PITCH]
        R_level_imu = se3.so3_exp([0, pitch, 0]) @ se3.so3_exp([roll, 0, 0])
        linear = R_level_imu.T @ packet[_LEVEL_VELOCITY]
        return TwistSample(stamp_ns, linear, packet[_ANGULAR_RATE].copy(), frame_id='imu')


def read_oxts(folder: Path, skips: Skips) -> OxtsLog | None:
    """Read the folder `oxts`, or return None where there is none or nothing in it can be read.

    Packets that are cut off, hold a NaN or repeat a stamp are counted and left out.

    Raises:
        DataError: timestamps.txt is missing or holds no date.
    """
    files = numbered_files(folder / 'data', ('.txt',), skips)
    if not files:
        return None
    stamps = stamps_of_numbers(
        list(files), read_date_stamps(folder / 'timestamps.txt'), folder / 'timestamps.txt', skips
    )
    packets: dict[int, NDArray[np.float64]] = {}
    for number, stamp in stamps.items():
        packet = _read_packet(files[number])
        if packet is None:
            message = f'{files[number]}: expected {_FIELDS} finite numbers'
            skips.add('broken OXTS packet', files[number], message)
        elif stamp in packets:
            skips.add('duplicate stamp', files[number], f'{files[number]}: repeats a stamp')
        else:
            packets[stamp] = packet
    if not packets:
        return None
    if list(packets) != sorted(packets):
        skips.note(f'{folder / "timestamps.txt"}: stamps go backwards; read in stamp order')
    ordered = sorted(packets)
    rows = np.stack([packets[stamp] for stamp in ordered])
    return OxtsLog(str(folder), np.array(ordered, np.int64), rows)


def _read_packet(path: Path) -> NDArray[np.float64] | None:
    try:
        packet = np.array(path.read_text().split(), np.float64)
    except (OSError, ValueError):
        return None
    return packet if packet.size == _FIELDS and np.isfinite(packet).all() else None


def _attitude(packet: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R_enu_imu: yaw 0 is east, counter-clockwise; the unit's axes are forward left up."""
    roll, pitch, yaw = packet[_ROLL], packet[_PITCH], packet[_YAW]
    return se3.so3_exp([0, 0, yaw]) @ se3.so3_exp([0, pitch, 0]) @ se3.so3_exp([roll, 0, 0])
