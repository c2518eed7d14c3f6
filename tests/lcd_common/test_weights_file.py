"""Weights and the state of a training survive a file; other files are refused in one line."""

import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from lcd_common import weights_file
from lcd_common.command_line import run
from lcd_common.errors import DataError


def trained(steps: int) -> tuple[nn.Module, torch.optim.Optimizer]:
    torch.manual_seed(3)
    network = nn.Sequential(nn.Linear(4, 3), nn.BatchNorm1d(3))
    optimizer = torch.optim.Adam(network.parameters(), lr=0.1)
    for _ in range(steps):
        step(network, optimizer)
    return network, optimizer


def step(network: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    network(torch.arange(8.0).reshape(2, 4)).square().sum().backward()
    optimizer.step()


def test_tensors_and_facts_come_back(tmp_path: Path) -> None:
    path = tmp_path / 'new' / 'weights.safetensors'
    turned = torch.arange(6.0).reshape(2, 3).T  # not contiguous
    weights_file.write(path, {'turned': turned}, {'step': 7, 'names': ['a']})
    stored = weights_file.read(path)
    assert torch.equal(stored.tensors['turned'], turned)
    assert stored.facts == {'step': 7, 'names': ['a']}
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_half_precision_leaves_counters_whole() -> None:
    network, _ = trained(1)
    halved = weights_file.weights_of(network, half=True)
    assert halved['0.weight'].dtype == torch.float16
    assert halved['1.num_batches_tracked'].dtype == torch.int64
    assert weights_file.weights_of(network)['0.weight'].dtype == torch.float32


def test_a_restored_training_takes_the_same_next_step(tmp_path: Path) -> None:
    network, optimizer = trained(3)
    path = tmp_path / 'checkpoint.safetensors'
    weights_file.write(path, weights_file.train_state(network, optimizer), {})
    step(network, optimizer)
    again, again_optimizer = trained(0)
    weights_file.restore(again, again_optimizer, weights_file.read(path).tensors)
    step(again, again_optimizer)
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name]), name


@pytest.mark.parametrize('content', [b'', b'no weights', pickle.dumps({'a': 1})])
def test_another_file_is_refused_with_its_writer_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'weights.safetensors'
    path.write_bytes(content)
    with pytest.raises(DataError, match=r'weights\.safetensors.*train_it wrote'):
        weights_file.read(path, writer='train_it')


def test_safetensors_of_others_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    path = tmp_path / 'weights.safetensors'
    save_file({'a': torch.zeros(2)}, path)
    with pytest.raises(DataError, match='holds no weights of this suite'):
        weights_file.read(path)


def test_a_missing_file_stays_a_missing_file_and_is_named(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / 'none.safetensors'
    with pytest.raises(FileNotFoundError):
        weights_file.read(path)

    def command() -> None:
        weights_file.read(path, writer='train_it')

    assert run(command) == 1
    assert capsys.readouterr().err == (
        f'error: {path}: no such file; expected weights that train_it wrote\n'
    )
