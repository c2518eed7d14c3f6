"""How long embedding and searching take, on the processor; the weights do not matter."""

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lcd_common.errors import LocalizationError
from uncertain_place_recognition.datasets.recorded import simulated_drive
from uncertain_place_recognition.ensemble import EmbeddingEnsemble
from uncertain_place_recognition.networks import minkloc3d, pointnetvlad
from uncertain_place_recognition.networks.shapes import build
from uncertain_place_recognition.retrieval.exact_index import CompactIndex, ExactIndex
from uncertain_place_recognition.retrieval.faiss_index import FaissIndex
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex
from uncertain_place_recognition.submap import SubmapMaker

MEMBERS = 5
LENGTH = 256
SIZES = (18_000, 100_000, 1_000_000)
_K = 10


def evaluate(work: Path, sizes: tuple[int, ...] = SIZES) -> dict[str, Any]:
    """Measure embedding of a simulated sweep's submap, and searches in maps of several sizes."""
    del work
    points = _submap()
    original = {'minkloc3d': minkloc3d.ORIGINAL, 'pointnetvlad': pointnetvlad.ORIGINAL}
    compact = {'minkloc3d': minkloc3d.COMPACT, 'pointnetvlad': pointnetvlad.COMPACT}
    figures: dict[str, Any] = {
        'speed_conditions': {
            'points': len(points),
            'threads': torch.get_num_threads(),
            'cores': os.cpu_count(),
            'length': LENGTH,
            'matches': _K,
        },
        'embed_ms': embed_ms(original['minkloc3d'], points, 1),
        'five_members_ms': embed_ms(original['minkloc3d'], points, MEMBERS),
        'compact_embed_ms': embed_ms(compact['minkloc3d'], points, 1),
        'compact_five_members_ms': embed_ms(compact['minkloc3d'], points, MEMBERS),
        'pointnetvlad_embed_ms': embed_ms(original['pointnetvlad'], points, 1, repeats=5),
        'pointnetvlad_five_members_ms': embed_ms(
            original['pointnetvlad'], points, MEMBERS, repeats=3
        ),
        'query_ms': {},
        'query_ms_by_index': {},
    }
    for size in sizes:
        found = search_ms(size)
        # The shared space asks one index; Mason et al. ask one for each member.
        figures['query_ms'][str(size)] = found['compact']
        figures['query_ms_by_index'][str(size)] = found
    return figures


def embed_ms(settings: Any, points: NDArray[np.float32], members: int, repeats: int = 15) -> float:
    """Return the median time to embed a submap by so many members."""
    ensemble = EmbeddingEnsemble([build(settings) for _ in range(members)])
    return median_ms(lambda: ensemble.embed(points), repeats)


def search_ms(size: int) -> dict[str, float]:
    """Return the median time of a search by each index, by rows like those of a drive."""
    asked = _walk(size)[:: max(size // 50, 1)]
    asked = asked + np.random.default_rng(0).normal(0.0, 0.3, asked.shape).astype(np.float32)
    query, best = asked[0], [-1]
    found: dict[str, float] = {}
    makers: dict[str, Callable[[], WindowedIndex]] = {
        'exact': lambda: ExactIndex(LENGTH),
        'compact': lambda: CompactIndex(LENGTH),
        'faiss_hnsw': lambda: FaissIndex(LENGTH),
    }
    for name, make in makers.items():
        try:
            index = make()
        except LocalizationError:
            continue  # faiss is optional
        _fill(index, size)
        found[name] = _search_ms(index, query, 1)
        if name == 'exact':
            found['mason'] = _search_ms(index, query, MEMBERS)
            best = [int(index.search(one, 1).place_id[0]) for one in asked]
        elif name == 'faiss_hnsw':
            same = [index.search(one, 1).place_id[0] for one in asked] == np.array(best)
            found['faiss_hnsw_same_as_exact'] = float(np.mean(same))
        del index
    return found


def _search_ms(index: WindowedIndex, query: NDArray[np.float32], searches: int) -> float:
    """Return the median time of so many searches: one for each member's index, all of a size."""
    return median_ms(lambda: [index.search(query, _K) for _ in range(searches)], 15)


def median_ms(call: Callable[[], Any], repeats: int) -> float:
    """Return the median wall time of a call after two that do not count."""
    times = []
    for number in range(repeats + 2):
        start = time.perf_counter()
        call()
        if number >= 2:
            times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def _fill(index: WindowedIndex, size: int) -> None:
    rows = _walk(size)
    for start in range(0, size, 20_000):
        part = rows[start : start + 20_000]
        index.add_many(np.arange(start, start + len(part)), part)


def _walk(size: int) -> NDArray[np.float32]:
    """Return rows like those of drives: neighbours are alike, and every 200th begins elsewhere."""
    rng = np.random.default_rng(1)
    rows = 0.1 * rng.standard_normal((size, LENGTH), np.float32)
    for start in range(0, size, 200):
        part = rows[start : start + 200]
        part[0] *= 10.0
        np.cumsum(part, axis=0, out=part)
    return rows


def _submap() -> NDArray[np.float32]:
    from bags.records import LidarScan

    drive = simulated_drive(200, length_m=100.0)
    scan = next(iter(drive.records(kinds=[LidarScan])))
    assert isinstance(scan, LidarScan)
    xyz = scan.cloud.xyz + np.array([0.0, 0.0, 1.73], np.float32)
    return SubmapMaker().make(type(scan.cloud)(xyz))
