"""A short drive that shows everything: a street again the same way, and one the other way."""

from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.itinerary import JourneyConfig


def demonstration() -> SimulatedDrive:
    """Return a drive of about 480 m, 76 s, with a 64-beam LiDAR, IMU and satellites.

    The town is one of those for training: round a block, and back.
    """
    journey = JourneyConfig(length=480.0, same_way=0.18, reverse=0.18, stops=0.0, speed=15.0)
    return SimulatedDrive(36, 0, journey, SensorsConfig(lidar='os1_64'))
