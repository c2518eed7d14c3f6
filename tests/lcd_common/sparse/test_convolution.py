"""Sparse convolution and its gradients against torch's dense convolution."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from lcd_common.errors import ConfigError, DataError
from lcd_common.sparse import InverseConv3d, SparseConv3d, SparseTensor, SubmanifoldConv3d, voxelize
from lcd_common.sparse.tensor import pack, sorted_tensor, unpack

SHAPE = (24, 22, 20)


def voxels(count: int = 3000, channels: int = 5, seed: int = 0) -> SparseTensor:
    generator = torch.Generator().manual_seed(seed)
    cells = torch.stack(
        [torch.randint(0, size, (count,), generator=generator) for size in (2, *SHAPE)], 1
    )
    cells = torch.unique(cells, dim=0)
    cells = cells[torch.randperm(len(cells), generator=generator)]
    features = torch.randn((len(cells), channels), generator=generator, dtype=torch.float64)
    return sorted_tensor(cells, features.requires_grad_())


def dense_weight(layer: torch.nn.Module) -> Tensor:
    weight = layer.weight
    return weight.view(*layer.kernel, *weight.shape[1:]).permute(4, 3, 0, 1, 2)


def at(grid: Tensor, coordinates: Tensor) -> Tensor:
    b, x, y, z = coordinates.unbind(1)
    return grid[b, :, x, y, z]


def check_gradients(sparse: Tensor, dense: Tensor, inputs: list[Tensor]) -> None:
    probe = torch.randn(sparse.shape, generator=torch.Generator().manual_seed(9)).double()
    for a, b in zip(
        torch.autograd.grad((sparse * probe).sum(), inputs, retain_graph=True),
        torch.autograd.grad((dense * probe).sum(), inputs),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('kernel', [1, 3, (1, 3, 5)])
@pytest.mark.parametrize('strided', [False, True])
def test_without_gradients_it_is_the_same_convolution(kernel: object, strided: bool) -> None:
    tensor = voxels()
    layer = (SparseConv3d if strided else SubmanifoldConv3d)(5, 7, kernel).double()
    scale = torch.linspace(-1.0, 2.0, 7, dtype=torch.float64)
    with_gradients = layer(tensor).features * scale
    with torch.no_grad():
        without = layer(tensor, scale).features
    assert with_gradients.requires_grad and not without.requires_grad
    torch.testing.assert_close(without, with_gradients.detach(), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize('kernel', [1, 3, 5, (3, 1, 1), (1, 3, 5)])
def test_submanifold_is_dense_convolution_on_the_voxels(kernel: object) -> None:
    tensor = voxels()
    layer = SubmanifoldConv3d(5, 7, kernel, bias=True).double()
    torch.nn.init.normal_(layer.bias)
    out = layer(tensor)
    grid = tensor.dense((0, 0, 0), SHAPE, 2)
    padding = tuple(size // 2 for size in layer.kernel)
    dense = at(
        functional.conv3d(grid, dense_weight(layer), layer.bias, padding=padding),
        tensor.coordinates,
    )
    torch.testing.assert_close(out.features, dense, rtol=1e-10, atol=1e-10)
    assert torch.equal(out.keys, tensor.keys)
    check_gradients(out.features, dense, [tensor.features, layer.weight, layer.bias])


@pytest.mark.parametrize(
    ('kernel', 'stride', 'padding', 'covered'),
    [
        (3, 2, None, True),
        (3, 2, None, False),
        (2, 2, 0, True),
        (2, 2, 0, False),
        ((3, 1, 1), (2, 1, 1), 0, True),
        (5, 2, 2, False),
    ],
)
def test_strided_is_dense_strided_convolution(
    kernel: object, stride: object, padding: object, covered: bool
) -> None:
    tensor = voxels()
    layer = SparseConv3d(5, 6, kernel, stride, padding, covered=covered).double()
    out = layer(tensor)
    # Room on all sides, so that outputs beyond the grid's edge are there as well.
    room = 8
    size = tuple(s + 2 * room for s in SHAPE)
    grid = tensor.dense((-room,) * 3, size, 2)
    dense = functional.conv3d(grid, dense_weight(layer), stride=layer.stride, padding=layer.padding)
    shift = torch.tensor([0, *(room // s for s in layer.stride)])
    values = at(dense, out.coordinates + shift)
    torch.testing.assert_close(out.features, values, rtol=1e-10, atol=1e-10)
    check_gradients(out.features, values, [tensor.features, layer.weight])
    if covered:  # nowhere else is the dense answer different from zero
        rest = dense.detach().clone()
        b, x, y, z = (out.coordinates + shift).unbind(1)
        rest[b, :, x, y, z] = 0.0
        assert not rest.any()
    else:
        cells = torch.div(
            tensor.coordinates, torch.tensor([1, *layer.stride]), rounding_mode='floor'
        )
        assert torch.equal(out.keys, torch.unique(pack(cells)))


def test_the_inverse_is_the_dense_transposed_convolution() -> None:
    tensor = voxels()
    down = SparseConv3d(5, 6, 2, 2, 0).double()
    back = InverseConv3d(6, 4, down).double()
    coarse = down(tensor)
    fine = back(coarse, tensor)
    grid = coarse.dense((0, 0, 0), tuple(s // 2 for s in SHAPE), 2)
    weight = back.weight.view(2, 2, 2, 6, 4).permute(3, 4, 0, 1, 2)
    dense = at(functional.conv_transpose3d(grid, weight, stride=2), tensor.coordinates)
    torch.testing.assert_close(fine.features, dense, rtol=1e-10, atol=1e-10)
    with pytest.raises(ConfigError, match='has seen'):
        back(coarse, voxels(seed=1))


def test_maps_are_made_once_for_a_level() -> None:
    tensor = voxels()
    first, second = SubmanifoldConv3d(5, 5).double(), SubmanifoldConv3d(5, 5).double()
    down = SparseConv3d(5, 5).double()
    out = second(first(tensor))
    assert list(tensor.maps) == [('submanifold', (3, 3, 3))] and out.maps is tensor.maps
    coarse, again = down(out), down(tensor)
    assert coarse.maps is again.maps
    first(coarse)
    assert ('submanifold', (3, 3, 3)) in again.maps


def test_many_voxels_on_two_threads_give_the_same_answer_each_time() -> None:
    tensor, layer = voxels(9000), SubmanifoldConv3d(5, 16)
    tensor = tensor.with_features(tensor.features.detach().float())
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        answers = [layer(tensor).features.detach() for _ in range(20)]
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(answers[0], answer) for answer in answers)


def test_voxels_hold_the_mean_of_their_points() -> None:
    generator = torch.Generator().manual_seed(3)
    xyz = 10.0 * torch.randn((4000, 3), generator=generator)
    batch = torch.randint(0, 3, (4000,), generator=generator)
    features = torch.randn((4000, 2), generator=generator)
    tensor = voxelize(xyz, features, (0.8, 0.9, 1.1), batch)
    cells = torch.floor(xyz / torch.tensor([0.8, 0.9, 1.1])).long()
    for row in range(0, len(tensor), 37):
        b, *cell = tensor.coordinates[row].tolist()
        inside = (batch == b) & (cells == torch.tensor(cell)).all(1)
        torch.testing.assert_close(tensor.features[row], features[inside].mean(0))
    assert tensor.clouds() == 3 and torch.equal(pack(unpack(tensor.keys)), tensor.keys)


def test_an_empty_cloud_passes_through() -> None:
    nothing = voxelize(torch.zeros((0, 3)), torch.zeros((0, 4)), (1.0, 1.0, 1.0))
    out = SparseConv3d(4, 8)(SubmanifoldConv3d(4, 4)(nothing))
    assert out.features.shape == (0, 8) and out.clouds() == 0


def test_mistakes_are_told() -> None:
    with pytest.raises(ConfigError, match='odd sizes'):
        SubmanifoldConv3d(5, 5, 2).double()(voxels())
    with pytest.raises(ConfigError, match='three'):
        SparseConv3d(1, 1, (3, 3))
    twice = torch.tensor([[0, 1, 2, 3], [0, 1, 2, 3]])
    with pytest.raises(DataError, match='twice'):
        sorted_tensor(twice, torch.zeros(2, 1))
    with pytest.raises(DataError, match='larger voxels'):
        voxelize(torch.full((1, 3), 1e6), torch.zeros(1, 1), (0.1, 0.1, 0.1))
    with pytest.raises(DataError, match='expected voxels'):
        sorted_tensor(twice[:, :3], torch.zeros(2, 1))
