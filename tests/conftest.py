"""Give ROS tests a context of their own, cut off from any other ROS on the network."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

# Before rclpy is imported anywhere: discovery on this host only, a domain that robots do not use.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(60 + os.getpid() % 40)
os.environ.setdefault('RCUTILS_LOGGING_USE_STDOUT', '0')
# Before torch is imported: its threads and those of other busy processes wait for each other.
os.environ.setdefault('OMP_NUM_THREADS', '1')

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'


@pytest.fixture(scope='session', autouse=True)
def one_registration_thread() -> None:
    """Let KISS-ICP use one thread in the whole session, whichever test comes first.

    Its number of threads belongs to the process; with more than one, runs repeat but for the last
    bits, and a test of repeated bytes would depend on the tests before it.
    """
    from lcd_loop_closure.kiss_registration import KissRegistration

    KissRegistration(max_range=100.0, min_range=0.0, voxel_size=1.0, max_num_threads=1)


@pytest.fixture(scope='session')
def real_data() -> Path:
    """Folder of real recordings beside the repository; tests that need it skip without."""
    if not DATA.is_dir():
        pytest.skip('the real recordings (../shared/data) are not on this machine')
    return DATA


@pytest.fixture(scope='session')
def ros() -> Iterator[None]:
    """Initialise rclpy once for all ROS tests."""
    import rclpy

    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def spin_until(ros: None) -> Iterator[Callable[..., bool]]:
    """Spin nodes until a condition holds: `spin_until([node], lambda: done, timeout_s=5)`."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()

    def spin(nodes: list, condition: Callable[[], bool], timeout_s: float = 10.0) -> bool:
        for node in nodes:
            if node not in executor.get_nodes():
                executor.add_node(node)
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            executor.spin_once(timeout_sec=0.05)
        return True

    yield spin
    executor.shutdown()


@pytest.fixture(scope='session')
def small_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an ensemble that nobody trained: it still tells scans apart."""
    import torch

    from uncertain_place_recognition.ensemble import PACKED, EmbeddingEnsemble
    from uncertain_place_recognition.networks.shapes import build, shape

    torch.manual_seed(0)
    small = shape('minkloc3d', 'compact', planes=(4, 4, 4), size=16)
    folder = tmp_path_factory.mktemp('weights')
    facts = {'submap': {'points': 512, 'fewest': 50}}
    EmbeddingEnsemble([build(small) for _ in range(2)], facts).save(folder / PACKED)
    return folder
