"""The place head on its own: batches by brute force, features of drives, the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from lcdnet_samples import TINY, street

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_loop_closure.evaluation.sweep_store import SweepWriter
from lcd_loop_closure.lcdnet import Lcdnet, checkpoint, place_head, train_place_head
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig
from lcd_loop_closure.lcdnet.losses import separation_loss
from lcd_loop_closure.lcdnet.netvlad import with_ranges
from lcd_loop_closure.lcdnet.place_features import (
    PlaceFeatures,
    around_loops,
    drive_features,
    joined_features,
    near_spots,
    second_run,
)
from lcd_loop_closure.lcdnet.place_head import (
    Neighbourhoods,
    PlaceHeadConfig,
    judge_place_head,
)
from lcd_loop_closure.lcdnet.voxels import Clouds

LENGTH_M, LAPS = 120.0, 2


class Drive:
    """Two laps along a street with the same points, sweeps 6 m apart."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        block = street(rng, 6000)
        self._points = block * np.array([LENGTH_M / 44.0, 1.0, 1.0], np.float32)
        x = np.arange(-50.0, 50.0, 6.0)
        x = np.concatenate([x, x[::-1] + 1.0])  # out and back
        yaw = np.where(np.arange(len(x)) < len(x) // 2, 0.0, np.pi)
        self.T_world_base = np.array(
            [se3.from_rotation_translation(se3.rotation_z(a)[:3, :3], (b, 0.0, 0.0))
             for a, b in zip(yaw, x, strict=True)]
        )  # fmt: skip

    def __len__(self):
        return len(self.T_world_base)

    def cloud(self, number):
        T = se3.inverse(self.T_world_base[number])
        xyz = (self._points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        return PointCloud(xyz, np.full(len(xyz), 0.5, np.float32)).within(2.0, 24.0)


def network(**changes):
    torch.manual_seed(0)
    return Lcdnet(replace(TINY, **changes))


def features(number=3, **changes):
    made = network(**changes)
    quiet = AugmentationConfig(shift=0.0)
    return made, joined_features([drive_features(made, Drive(k), k, quiet) for k in range(number)])


def test_the_loss_is_its_formula():
    rng = np.random.default_rng(0)
    d = rng.normal(size=(9, 5))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    x = np.array([0.0, 1.0, 2.5, 7.0, 8.0, 20.0, 21.5, 50.0, np.nan])
    away = np.abs(x[:, None] - x)
    away[2, 3] = away[3, 2] = np.nan  # this pair does not count
    same = (away < 4.0) & ~np.eye(9, dtype=bool)
    s, t, losses, confused = d @ d.T, 0.1, [], []
    for i, j in np.argwhere(same):
        others = s[i][away[i] > away[i, j] + 1.5]
        losses.append(np.log1p(np.exp((others - s[i, j]) / t).sum()))
        confused.append(others.max() > s[i, j])
    loss, share = separation_loss(*map(torch.from_numpy, (d, same, away)), t, 1.5)
    assert len(losses) == 10
    assert float(loss) == pytest.approx(np.mean(losses), rel=1e-6)
    assert share == pytest.approx(np.mean(confused))
    none = torch.zeros(9, 9, dtype=torch.bool)
    assert separation_loss(torch.from_numpy(d), none, torch.from_numpy(away), t, 1.5)[0] == 0.0


def test_a_row_without_negatives_leaves_the_slope_finite():
    d = torch.nn.functional.normalize(torch.randn(4, 3), dim=1).requires_grad_()
    same = torch.tensor([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]]).bool()
    away = torch.full((4, 4), torch.nan)
    away[same] = 1.0
    away[0, 2] = away[2, 0] = 9.0
    separation_loss(d, same, away, 0.05, 1.5)[0].backward()
    assert bool(torch.isfinite(d.grad).all()) and bool((d.grad[:3] != 0).any())


def test_rings_tell_distance_and_nothing_of_the_direction():
    keypoints = torch.tensor([[[0.0, 0.0, 3.0], [0.0, 25.0, -1.0], [30.0, 40.0, 0.0]]])
    wide = with_ranges(torch.zeros(1, 3, 4), keypoints, 3, 50.0)
    assert wide.shape == (1, 3, 7)
    expected = 2.0 * np.exp(
        -(((np.array([[0.0], [25.0], [50.0]]) - [0.0, 25.0, 50.0]) / 25.0) ** 2)
    )
    np.testing.assert_allclose(wide[0, :, 4:].numpy(), expected, atol=1e-6)
    turned = keypoints @ torch.from_numpy(se3.rotation_z(1.0)[:3, :3].T).float()
    torch.testing.assert_close(with_ranges(torch.zeros(1, 3, 4), turned, 3, 50.0), wide)
    with pytest.raises(ConfigError, match='at least 2 rings'):
        replace(TINY, place_ranges=1).check()


def test_features_are_those_that_the_network_sees():
    made, drive = network(place_ranges=4), Drive(0)
    found = drive_features(made, drive, 7, None, chosen=np.array([2, 5]))
    assert found.town.tolist() == [7, 7] and found.path_m.tolist() == pytest.approx([12.0, 30.0])
    cloud = drive.cloud(5)
    with torch.inference_mode():
        seen = made(Clouds.of([torch.from_numpy(cloud.xyz)], [torch.from_numpy(cloud.intensity)]))
    assert found.position[1].tolist() == drive.T_world_base[5, :3, 3].tolist()
    assert seen.descriptors.shape == (1, 32) and found.values.shape == (2, 48, 16)


def test_neighbourhoods_have_loops_and_relations_are_true():
    _, made = features()
    settings = PlaceHeadConfig(groups=3, sweeps=8, around=30.0, same=4.0)
    groups = Neighbourhoods(made, settings)
    position, town = made.position.numpy(), made.town.numpy()
    for seed in range(20):
        rows = groups.draw(np.random.default_rng(seed))
        assert len(set(rows.tolist())) == len(rows) <= 24
        same, apart = groups.relations(rows)
        assert same.any()
        for a, i in enumerate(rows):
            for b, j in enumerate(rows):
                away = np.linalg.norm(position[i] - position[j])
                far = abs(float(made.path_m[i] - made.path_m[j])) > 50.0
                own = town[i] == town[j]
                assert same[a, b] == (own and away <= 4.0 and far)
                if not own:
                    assert np.isinf(apart[a, b])
                else:
                    assert apart[a, b] == pytest.approx(away) if far else np.isnan(apart[a, b])


def test_the_head_learns_and_nothing_else_changes(tmp_path):
    made, known = features(place_ranges=4)
    before = {name: value.clone() for name, value in made.state_dict().items()}
    settings = PlaceHeadConfig(steps=60, groups=3, sweeps=8, learning_rate=0.005)
    losses = [loss for _, loss, _ in train_place_head.train_place_head(made, known, settings)]
    assert np.mean(losses[-15:]) < 0.7 * np.mean(losses[:15])
    changed = {
        name for name, value in made.state_dict().items() if not torch.equal(value, before[name])
    }
    assert changed and all(name.startswith('place.') for name in changed)
    with pytest.raises(ConfigError, match='at least one drive'):
        joined_features([])
    alone = drive_features(made, Drive(0), 0, None, chosen=np.arange(8))
    with pytest.raises(ConfigError, match='none of the drives returns'):
        Neighbourhoods(alone, settings)


def test_a_sector_is_left_out_of_what_the_head_sees():
    _, known = features(1)
    rows = np.arange(6)
    settings = PlaceHeadConfig(keypoints=24, sector=180.0)
    for seed in range(5):
        values, at = place_head._some_keypoints(known, rows, settings, np.random.default_rng(seed))
        assert values.shape == (6, 24, 16) and at.shape == (6, 24, 3)
        for row in range(6):
            of = [known.keypoints[row].float().tolist().index(one) for one in at[row].tolist()]
            assert len(set(of)) == 24
            torch.testing.assert_close(values[row], known.values[row][of].float())


def test_drives_are_judged_by_protocol_1():
    made = network()
    drive = drive_features(made, Drive(0), 0, None)
    curve = judge_place_head(made, drive)
    assert curve.loops > 0 and 0.0 <= curve.average_precision <= 1.0
    shown = [judge_place_head(made, drive, hidden=PlaceHeadConfig(keypoints=k)) for k in (32, 16)]
    assert [one.loops for one in shown] == [curve.loops] * 2
    again = judge_place_head(made, drive, hidden=PlaceHeadConfig(keypoints=16))
    assert shown[1].average_precision == again.average_precision, 'the same is left out each time'
    assert shown[1].average_precision != curve.average_precision


def test_only_what_lies_around_loops_is_taken():
    drive = Drive(0)
    position = drive.T_world_base[:, 0, 3]
    kept = around_loops(drive, loop_m=4.0, around_m=7.0)
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position)))])
    loops = [
        position[i]
        for i in range(len(drive))
        if any(
            abs(position[i] - position[j]) <= 4.0 and abs(path[i] - path[j]) > 50.0
            for j in range(len(drive))
        )
    ]
    expected = [i for i, x in enumerate(position) if np.abs(np.array(loops) - x).min() <= 7.0]
    assert kept.tolist() == expected and len(expected) < len(drive)


def test_features_are_kept_with_what_made_them(tmp_path):
    made = network()
    found = drive_features(made, Drive(0), 0, None, chosen=np.arange(3))
    path = tmp_path / 'features.safetensors'
    assert PlaceFeatures.load(path, 'a') is None
    found.save(path, 'a')
    assert PlaceFeatures.load(path, 'b') is None
    again = PlaceFeatures.load(path, 'a')
    assert torch.equal(again.values, found.values) and torch.equal(again.path_m, found.path_m)
    path.write_bytes(b'nothing')
    with pytest.raises(DataError, match='train_lcdnet_place_head wrote'):
        PlaceFeatures.load(path, 'a')


def test_the_command_trains_and_keeps_a_card(tmp_path, capsys):
    weights, data, out = tmp_path / 'w.safetensors', tmp_path / 'drives', tmp_path / 'out'
    checkpoint.save_network(weights, network(), {'training': {'steps': 1}})
    for town in (0, 100):
        drive = Drive(town)
        with SweepWriter(data / f'drive_{town:03d}', f'drive_{town:03d}') as writer:
            for k in range(len(drive)):
                writer.add(k, drive.cloud(k), drive.T_world_base[k])
    command = [str(weights), '--out', str(out), '--data', str(data), '--towns', '1']
    command += ['--validation-towns', '1', '--validate-every', '10', '--quiet', '--device', 'cpu']
    command += ['--threads', '1', '--mix', '0.5', '--train', 'steps=20', 'groups=2', 'sweeps=6']
    assert train_place_head.main([*command, '--set', 'place_ranges=4']) == 0
    made, facts = checkpoint.load_network(out / 'best.safetensors')
    assert made.settings.place_ranges == 4 and facts['training'] == {'steps': 1}
    assert facts['place_head']['trained_on'].startswith('simulation only')
    card = json.loads((out / 'best.json').read_text())['place_head']
    assert card['training']['steps'] == 20 and card['share_of_the_head_before'] == 0.5
    rows = [json.loads(line) for line in (out / 'place_head.jsonl').read_text().splitlines()]
    assert [row['step'] for row in rows] == [0, 10, 20]
    assert all(0.0 <= row['without_sectors'] <= 1.0 for row in rows)
    assert (out / 'place_head.png').stat().st_size > 3000
    assert train_place_head.main([*command, '--set', 'voxel=0.3']) == 1
    assert 'may change the place head alone' in capsys.readouterr().err


def test_weights_lie_between_before_and_after():
    after = network()
    start = {k: v + 1.0 for k, v in after.place.state_dict().items()}
    assert train_place_head._mixed(after, start, 0.0) is after
    mixed = train_place_head._mixed(after, start, 0.25)
    for name, value in mixed.place.state_dict().items():
        own = after.place.state_dict()[name]
        expected = 0.75 * own + 0.25 * start[name] if own.is_floating_point() else own
        torch.testing.assert_close(value, expected)
    torch.testing.assert_close(mixed.state_dict(), {**after.state_dict(), **{
        f'place.{k}': v for k, v in mixed.place.state_dict().items()
    }})  # fmt: skip


def test_whatever_a_second_run_sees_is_a_return():
    made, first = features(1)
    second = drive_features(made, Drive(0), 0, AugmentationConfig(shift=0.0), seed=1)
    both = second_run(first, second)
    n = len(first)
    assert len(both) == 2 * n and not torch.equal(both.values[:n], both.values[n:])
    same, away = Neighbourhoods(both, PlaceHeadConfig()).relations(np.arange(2 * n))
    between = away[:n, n:]
    assert np.isfinite(between).all() and same[:n, n:].diagonal().all()
    expected = (first.position[:, None] - second.position).norm(dim=2).numpy()
    np.testing.assert_allclose(between, expected, atol=1e-9)
    curve = judge_place_head(made, both, first=n)
    assert curve.loops == n, 'each sweep of the second run has its place in the first'


def test_sweeps_near_spots_are_found_by_their_poses():
    drive = Drive(0)
    spots = drive.T_world_base[[3, 10], :3, 3] + [0.0, 0.5, 0.0]
    away = np.linalg.norm(drive.T_world_base[:, None, :3, 3] - spots, axis=2).min(1)
    assert near_spots(drive, spots, 1.0).tolist() == np.flatnonzero(away <= 1.0).tolist()
