"""Ensembles: shared work gives what work done apart gives; files; dropout; variance."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import small_run

from lcd_common.errors import ConfigError, DataError
from uncertain_place_recognition.ensemble import EmbeddingEnsemble
from uncertain_place_recognition.networks.shapes import NETWORKS, build, shape

SMALL = {
    'minkloc3d': shape('minkloc3d', voxel=0.1, planes=(4, 6, 6), size=8),
    'pointnetvlad': shape(
        'pointnetvlad', points=32, widths=(4, 4, 4, 6, 8), transform_widths=(4, 6, 8, 6, 4),
        clusters=3, size=8,
    ),
    'bev_netvlad': shape(
        'bev_netvlad', rows=12, columns=16, widths=(4, 6), blocks=(1, 1), clusters=3, size=8
    ),
}  # fmt: skip
POINTS = small_run(points=128).points.astype(np.float32)


def _members(name, count=3, **changes):
    networks = []
    for seed in range(count):
        torch.manual_seed(seed)
        network = build(replace(SMALL[name], **changes))
        network.train()
        network.embed(torch.from_numpy(POINTS))  # running statistics of its own
        networks.append(network.eval())
    return networks


@pytest.mark.parametrize('name', NETWORKS)
def test_members_give_together_what_each_gives_alone(name):
    members = _members(name)
    ensemble = EmbeddingEnsemble(members)
    found = ensemble.embed(POINTS[0])
    assert found.shape == (3, 8) == (ensemble.size, ensemble.length)
    assert found.dtype == np.float32
    with torch.no_grad():
        apart = [member.embed(torch.from_numpy(POINTS[:1]))[0].numpy() for member in members]
    np.testing.assert_array_equal(found, np.array(apart))
    many = ensemble.embed_many(POINTS[:4])
    assert many.shape == (4, 3, 8)
    np.testing.assert_allclose(many[0], found, rtol=1e-4, atol=1e-5)


def test_kernel_maps_are_found_once_for_all_members(monkeypatch):
    from lcd_common.sparse import convolution

    calls = []
    plain = convolution.submanifold_map
    monkeypatch.setattr(
        convolution, 'submanifold_map', lambda *given: calls.append(1) or plain(*given)
    )
    EmbeddingEnsemble(_members('minkloc3d', 1)).embed(POINTS[0])
    alone = len(calls)
    assert alone
    calls.clear()
    members = _members('minkloc3d', 4)
    calls.clear()
    EmbeddingEnsemble(members).embed(POINTS[0])
    assert len(calls) == len(set(range(len(calls)))) == 4  # one for each level, not for each member


@pytest.mark.parametrize('name', NETWORKS)
def test_a_saved_ensemble_comes_back_in_one_file(name, tmp_path):
    ensemble = EmbeddingEnsemble(_members(name), {'role': 'ensemble', 'submap': {'reach': 40.0}})
    ensemble.save(tmp_path / 'ensemble.safetensors', half=False)
    again = EmbeddingEnsemble.load(tmp_path)
    assert again.settings == ensemble.settings and again.submap.reach == 40.0
    assert again.facts['role'] == 'ensemble' and again.size == 3
    np.testing.assert_array_equal(again.embed(POINTS[1]), ensemble.embed(POINTS[1]))
    ensemble.save(tmp_path / 'half.safetensors')
    halved = EmbeddingEnsemble.load(tmp_path / 'half.safetensors')
    found, expected = halved.embed(POINTS[1]), ensemble.embed(POINTS[1])
    np.testing.assert_allclose(found, expected, atol=5e-3 * np.abs(expected).max())


def test_dropout_gives_passes_that_differ_and_repeat():
    ensemble = EmbeddingEnsemble(_members('minkloc3d', 1, dropout=0.5), passes=4)
    found = ensemble.embed(POINTS[0])
    assert found.shape == (4, 8) and ensemble.size == 4
    assert len(np.unique(found[:, 0])) == 4
    state = torch.random.get_rng_state()
    np.testing.assert_array_equal(ensemble.embed(POINTS[0]), found)
    assert torch.equal(torch.random.get_rng_state(), state)  # others' draws are left alone
    normalised = [m for m in ensemble.members[0].modules() if isinstance(m, torch.nn.BatchNorm1d)]
    assert normalised and not any(m.training for m in normalised)


def test_variance_is_given_where_there_is_a_head():
    ensemble = EmbeddingEnsemble(_members('bev_netvlad', 1, variance=True))
    mean, variance = ensemble.embed_with_variance(POINTS[0])
    assert mean.shape == variance.shape == (1, 8)
    assert ((variance > 0) & (variance < 1)).all()
    assert EmbeddingEnsemble(_members('bev_netvlad', 1)).embed_with_variance(POINTS[0])[1] is None


def test_what_is_wrong_is_said(tmp_path):
    with pytest.raises(ConfigError, match='members of one shape'):
        EmbeddingEnsemble([])
    with pytest.raises(ConfigError, match='2 shapes'):
        EmbeddingEnsemble([*_members('minkloc3d', 1), *_members('bev_netvlad', 1)])
    ensemble = EmbeddingEnsemble(_members('bev_netvlad', 1), {'normalisation': 'benchmark'})
    with pytest.raises(DataError, match='P x 3'):
        ensemble.embed(POINTS[0][:, :2])
    with pytest.raises(DataError, match='NaN'):
        ensemble.embed(np.full((5, 3), np.nan, np.float32))
    with pytest.raises(ConfigError, match='PointNetVLAD benchmark alone'):
        _ = ensemble.submap
    with pytest.raises(DataError, match='train one first'):
        EmbeddingEnsemble.load(tmp_path)
    with pytest.raises(DataError, match='no such file of weights'):
        EmbeddingEnsemble.load(tmp_path / 'other.safetensors')
    (tmp_path / 'best.safetensors').write_bytes(b'x' * 64)
    with pytest.raises(DataError, match='no weights for places'):
        EmbeddingEnsemble.load(tmp_path)
    ensemble.save(tmp_path / 'best.safetensors')
    _spoil(tmp_path / 'best.safetensors')
    with pytest.raises(DataError, match='do not fit'):
        EmbeddingEnsemble.load(tmp_path)


def _spoil(path):
    from lcd_common.weights_file import read, write

    stored = read(path)
    tensors = {k: v for k, v in stored.tensors.items() if 'compress' not in k}
    write(path, tensors, stored.facts)
