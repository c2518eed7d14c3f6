import numpy as np
import pytest
from evaluation_samples import World, out_and_back

from lcd_loop_closure.evaluation.descriptions import describe_sweeps
from lcd_loop_closure.scan_context import ScanContext


class Counting(ScanContext):
    def __init__(self) -> None:
        super().__init__()
        self.described = 0

    def describe(self, cloud):
        self.described += 1
        return super().describe(cloud)


@pytest.fixture
def descriptor():
    return Counting()


def test_descriptors_are_kept_and_found_again(descriptor, tmp_path):
    world = World(out_and_back(15.0))
    first = describe_sweeps(descriptor, world, folder=tmp_path, key='a')
    assert descriptor.described == len(world.T_world_base) == len(first.describe_ms)
    again = describe_sweeps(descriptor, world, folder=tmp_path, key='a')
    assert descriptor.described == len(world.T_world_base)
    assert np.array_equal(first.rows, again.rows)
    expected = ScanContext()
    assert np.array_equal(first.rows[3], expected.row(expected.describe(world.cloud(3))))


@pytest.mark.parametrize('what', ['settings', 'drive'])
def test_those_of_other_settings_or_drives_are_not_taken_for_them(descriptor, tmp_path, what):
    world = World(out_and_back(15.0))
    describe_sweeps(descriptor, world, folder=tmp_path, key='a')
    before = descriptor.described
    moved = world.T_world_base.copy()
    moved[:, 1, 3] += 3.0
    other = world if what == 'settings' else World(moved)
    describe_sweeps(descriptor, other, folder=tmp_path, key='b' if what == 'settings' else 'a')
    assert descriptor.described == 2 * before


def test_without_a_folder_nothing_is_kept(descriptor, tmp_path):
    world = World(out_and_back(6.0))
    steps = []
    describe_sweeps(descriptor, world, progress=lambda: steps.append(1))
    assert len(steps) == descriptor.described == len(world.T_world_base)
    assert not list(tmp_path.iterdir())
