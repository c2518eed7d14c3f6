"""The frozen test sets: whoever changes them makes every published figure another one."""

from bags.simulation.held_out import TEST_SETS
from bags.simulation.lidar_model import LIDARS
from bags.simulation.stream import TEST_SEEDS


def test_the_sets_are_what_they_were() -> None:
    frozen = {
        name: (held_out.towns, held_out.style, held_out.lidar)
        for name, held_out in TEST_SETS.items()
    }
    assert frozen == {
        'same_way': ((200, 201, 202), None, 'hdl64'),
        'reverse': ((200, 201, 202), None, 'hdl64'),
        'aliased_same_way': ((209,), 'aliased', 'hdl64'),
        'second_sensor_same_way': ((203,), None, 'os1_64'),
        'second_sensor_reverse': ((203,), None, 'os1_64'),
    }
    for name, held_out in TEST_SETS.items():
        assert set(held_out.towns) <= set(TEST_SEEDS) and held_out.lidar in LIDARS
        journey = held_out.journey
        assert (journey.length, journey.lateral) == (2500.0, 1.5)
        shares = (0.3, 0.0) if name.endswith('same_way') else (0.0, 0.3)
        assert (journey.same_way, journey.reverse) == shares


def test_drives_have_the_towns_names_and_the_revisits_of_their_class() -> None:
    (name, drive), *others = TEST_SETS['second_sensor_reverse'].drives(1).items()
    assert name == 'town_203' and not others
    assert drive.town.seed == 203 and drive.lidar.name == 'os1_64'
    plan = drive.journey.plan
    assert 0.2 < plan.reverse < 0.4 and plan.same_way < 0.05
