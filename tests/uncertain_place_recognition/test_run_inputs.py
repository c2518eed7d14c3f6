"""Submaps are embedded only by weights that were trained on such submaps."""

from dataclasses import asdict, replace

import pytest
from small_runs import small_run

from lcd_common.errors import DataError
from uncertain_place_recognition.ensemble import EmbeddingEnsemble
from uncertain_place_recognition.networks.shapes import build, shape
from uncertain_place_recognition.run_inputs import embed_submaps
from uncertain_place_recognition.submap import SubmapConfig

METRIC = {'submap': asdict(SubmapConfig(points=64))}
BENCHMARK = {'normalisation': 'benchmark', 'set': 'pointcloud_20m'}


def ensemble(facts):
    changes = {'rows': 8, 'columns': 16, 'widths': (6, 8), 'blocks': (1, 1), 'clusters': 4}
    return EmbeddingEnsemble([build(shape('bev_netvlad', 'compact', size=8, **changes))], facts)


def run_of(facts):
    return replace(small_run('a', count=3), facts=facts)


@pytest.mark.parametrize('facts', [METRIC, BENCHMARK])
def test_alike_submaps_are_embedded(facts):
    found = embed_submaps(run_of(facts), {'students': ensemble(facts)})
    assert found.of('students').shape == (3, 1, 8)
    fewer = {**facts, 'submap': {**METRIC['submap'], 'fewest': 100}}
    assert len(embed_submaps(run_of(fewer), {'students': ensemble(facts)})) == 3


def test_metric_weights_do_not_embed_the_benchmark_nor_the_other_way_round():
    with pytest.raises(
        DataError, match='normalisation benchmark, the weights of students know met'
    ):
        embed_submaps(run_of(BENCHMARK), {'students': ensemble(METRIC)})
    with pytest.raises(
        DataError, match='normalisation metric, the weights of naive know benchmark'
    ):
        embed_submaps(run_of(METRIC), {'naive': ensemble(BENCHMARK)})


def test_another_reach_or_number_of_points_is_refused():
    far = {'submap': {**METRIC['submap'], 'reach': 30.0, 'top': 20.0}}
    with pytest.raises(
        DataError,
        match=r'reach 30\.0 \(weights: 50\.0\), top 20\.0 \(weights: 30\.0\); make it anew',
    ):
        embed_submaps(run_of(far), {'students': ensemble(METRIC)})
    more = {'submap': asdict(SubmapConfig(points=4096))}
    with pytest.raises(DataError, match=r'points 64 \(weights: 4096\)'):
        embed_submaps(run_of({}), {'students': ensemble(more)})
    assert len(embed_submaps(run_of({}), {'students': ensemble({})})) == 3
