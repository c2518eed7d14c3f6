"""How long LCDNet takes, stage by stage, and how that grows."""

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.lcdnet_drives import methods
from benchmarks.lcdnet_real import in_base
from benchmarks.loop_pairs import TRUE_PAIR, kitti_00
from lcd_common.cloud import PointCloud
from lcd_loop_closure.compact_cloud import compact
from lcd_loop_closure.compact_search import CompactSearch
from lcd_loop_closure.descriptor_index import DescriptorIndex, Euclidean
from lcd_loop_closure.evaluation.lcdnet_registration import (
    LcdnetFast,
    LcdnetRansac,
    NodeRegistration,
)
from lcd_loop_closure.lcdnet import COMPACT, FULL, Lcdnet
from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor
from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud
from lcd_loop_closure.report.plots import STYLE

_LENGTH = 256
SIZES = (18_235, 1_000_000)
# The thesis's own, on an i7-6850K with a GTX 1080 Ti (Tables 3.10 and 3.11).
THESIS = {'descriptor_ms': 94.6, 'query_ms_18235': 5.0, 'fast_ms': 4.7, 'ransac_ms': 1135.0}


def evaluate(work: Path) -> dict[str, Any]:
    """Measure all of this; the weights do not matter, untrained ones stand in for missing ones."""
    scans, _ = kitti_00()
    match, query = (in_base(scans[i]) for i in TRUE_PAIR)
    compact_cpu, trained = _compact()
    figures: dict[str, Any] = {
        'speed_conditions': {
            'points': len(query),
            'threads_compact': torch.get_num_threads(),
            'threads_full_and_query': os.cpu_count(),
            'cores': os.cpu_count(),
            'trained_weights': trained,
            'thesis': THESIS,
        },
        'descriptor_ms': {'compact_cpu': describe_ms(compact_cpu, query)},
    }
    node_threads = torch.get_num_threads()
    # The compact network runs beside other nodes, on one thread; what is larger takes every core.
    every = os.cpu_count() or 1
    full = LcdnetDescriptor(LcdnetDescriptorConfig(device='cpu', threads=every), Lcdnet(FULL))
    figures['descriptor_ms']['full_cpu'] = describe_ms(full, query, repeats=5)
    figures['query_ms'] = {str(size): search_ms(size) for size in SIZES}
    torch.set_num_threads(node_threads)
    if torch.cuda.is_available():
        on_gpu = LcdnetDescriptor(LcdnetDescriptorConfig(device='cuda'), Lcdnet(FULL))
        figures['descriptor_ms']['full_gpu'] = describe_ms(on_gpu, query)
    figures |= _registration(compact_cpu, match, query)
    features = compact_cpu.features(query)
    reduced = compact(reduce_cloud(query, ReductionConfig()))
    figures['keyframe_bytes'] = features.nbytes + reduced.nbytes + 4 * compact_cpu.length
    figures['keyframe_bytes_by_part'] = {
        'features': features.nbytes,
        'cloud': reduced.nbytes,
        'descriptor': 4 * compact_cpu.length,
    }
    figures['query_ms_index_18235'] = index_ms(SIZES[0])
    figures['growth'] = growth(compact_cpu, query)
    draw_growth(figures['growth'], work / 'lcdnet_growth.png')
    return figures


def describe_ms(descriptor: LcdnetDescriptor, cloud: PointCloud, repeats: int = 15) -> float:
    """Return the median time to describe a sweep, features included."""
    # A new object each time: the one described last is remembered.
    return median_ms(lambda: descriptor.describe(PointCloud(cloud.xyz, cloud.intensity)), repeats)


def search_ms(size: int, length: int = _LENGTH) -> float:
    """Return the median time of an exhaustive search among so many descriptors."""
    search = CompactSearch(length, size)
    rng = np.random.default_rng(0)
    for start in range(0, size, 50_000):
        search.add(_units(rng, min(50_000, size - start), length))
    query = _units(rng, 1, length)[0]
    return median_ms(lambda: search.nearest(query), 15)


def index_ms(size: int, length: int = _LENGTH) -> float:
    """Return the median time of a query of the index that the node runs."""
    index = DescriptorIndex(Euclidean(length, unit_length=True), 0.0)
    rng = np.random.default_rng(0)
    for number, row in enumerate(_units(rng, size, length)):
        index.add(number, row, -np.inf)
    query = _units(rng, 1, length)[0]
    return median_ms(lambda: index.nearest(query, 0.0, 10), 15)


def growth(descriptor: LcdnetDescriptor, cloud: PointCloud) -> dict[str, dict[str, float]]:
    """Return times over points of a sweep, keyframes of a map and cores."""
    rng = np.random.default_rng(0)
    shuffled = cloud.select(rng.permutation(len(cloud)))
    by_points = {
        str(int(share * len(cloud))): describe_ms(
            descriptor, shuffled.select(np.arange(int(share * len(cloud)))), 7
        )
        for share in (0.1, 0.25, 0.5, 0.75, 1.0)
    }
    by_keyframes = {str(size): search_ms(size) for size in (1_000, 10_000, 100_000, 300_000)}
    threads, by_threads = torch.get_num_threads(), {}
    for number in range(1, (os.cpu_count() or 1) + 1):
        torch.set_num_threads(number)
        by_threads[str(number)] = describe_ms(descriptor, cloud, 7)
    torch.set_num_threads(threads)
    return {
        'descriptor_ms_by_points': by_points,
        'query_ms_by_keyframes': by_keyframes,
        'descriptor_ms_by_threads': by_threads,
    }


def draw_growth(figures: dict[str, dict[str, float]], path: Path) -> None:
    """Draw the times over points, keyframes and cores."""
    labels = ('points of a sweep', 'keyframes', 'threads')
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 3.4), dpi=120, layout='constrained')
        FigureCanvasAgg(figure)
        for ax, (key, values), label in zip(
            figure.subplots(1, 3), figures.items(), labels, strict=True
        ):
            ax.plot([int(k) for k in values], list(values.values()), marker='o', color='#0072B2')
            ax.set_xlabel(label)
            ax.set_ylabel('query [ms]' if key.startswith('query') else 'descriptor [ms]')
            ax.set_ylim(0, None)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, facecolor='white')


def median_ms(work: Callable[[], object], repeats: int) -> float:
    """Return the median wall time of some runs, after one that warms up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def _registration(
    descriptor: LcdnetDescriptor, match: PointCloud, query: PointCloud
) -> dict[str, Any]:
    ransac, fast = LcdnetRansac(descriptor), LcdnetFast(descriptor)
    node = NodeRegistration(descriptor)
    a, b = ransac.prepare(match), ransac.prepare(query)
    c, d = node.prepare(match), node.prepare(query)
    return {
        'registration_ms': median_ms(lambda: ransac.register(a, b), 15),
        'registration_fast_ms': median_ms(lambda: fast.register(a, b), 15),
        'registration_refined_ms': median_ms(lambda: node.register(c, d), 7),
    }


def _compact() -> tuple[LcdnetDescriptor, bool]:
    from lcd_common.errors import ConfigError

    try:
        descriptor: LcdnetDescriptor = methods().lcdnet
    except ConfigError:
        torch.manual_seed(0)
        return LcdnetDescriptor(LcdnetDescriptorConfig(device='cpu'), Lcdnet(COMPACT)), False
    return descriptor, True


def _units(rng: np.random.Generator, number: int, length: int) -> np.ndarray:
    rows = rng.standard_normal((number, length), np.float32)
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))
