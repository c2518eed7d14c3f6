"""The frozen test sets: drives through towns that nothing was trained or chosen on."""

from dataclasses import dataclass

from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.itinerary import JourneyConfig
from bags.simulation.town import SimulatedTown

# One class of revisits each, so that a class has an average precision of its own, as KITTI 00 and
# KITTI 08 have.
_SAME_WAY = JourneyConfig(length=2500.0, same_way=0.3, reverse=0.0, lateral=1.5)
_REVERSE = JourneyConfig(length=2500.0, same_way=0.0, reverse=0.3, lateral=1.5)


@dataclass(frozen=True)
class HeldOut:
    """A test set: the same journey through some towns.

    Attributes:
        towns: their seeds.
        journey: length and revisits.
        style: of all streets, None for a mixture.
        lidar: model of the sensor.
    """

    towns: tuple[int, ...]
    journey: JourneyConfig
    style: str | None = None
    lidar: str = 'hdl64'

    def drives(self, towns: int | None = None) -> dict[str, SimulatedDrive]:
        """Return the drives by name, at most so many."""
        sensors = SensorsConfig(lidar=self.lidar)
        return {
            f'town_{seed}': SimulatedDrive(
                SimulatedTown(seed, self.style), journey=self.journey, sensors=sensors
            )
            for seed in self.towns[:towns]
        }


TEST_SETS = {
    'same_way': HeldOut((200, 201, 202), _SAME_WAY),
    'reverse': HeldOut((200, 201, 202), _REVERSE),
    'aliased_same_way': HeldOut((209,), _SAME_WAY, style='aliased'),
    'second_sensor_same_way': HeldOut((203,), _SAME_WAY, lidar='os1_64'),
    'second_sensor_reverse': HeldOut((203,), _REVERSE, lidar='os1_64'),
}
