"""One update is timed through the node, its Path included."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')
from benchmarks import graph_update

pytestmark = pytest.mark.ros


def test_a_small_graph_gives_every_figure(tmp_path: Path) -> None:
    figures = graph_update.evaluate(tmp_path, keyframes=150, measured=50)
    assert figures['keyframes'] == 150
    assert figures['measured_updates'] == 50
    assert 0.0 < figures['path_share'] < 1.0
    assert 0.0 < figures['path_p50_ms'] <= figures['p50_ms'] <= figures['p99_ms']
    assert np.isfinite(figures['rmse_m'])
