"""The child process finds what the search finds here, and may be killed."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orphans import ends_with_its_parent
from simulated_street import street, view

from bags.street.drive import T_BASE_LIDAR
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.descriptor_choice import DescriptorConfig
from lcd_loop_closure.keyframes import Keyframe, KeyframeConfig, KeyframeSelector
from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig
from lcd_loop_closure.loop_detector import LoopDetectorSettings
from lcd_loop_closure.loop_search import LoopSearch, SearchJob, Session
from lcd_loop_closure.radius_search import GraphPositions
from lcd_loop_closure.search_process import Found, SearchProcess, SearchProcessError, Sweep

# LCDNet's network would be loaded by every child.
SETTINGS = LoopDetectorSettings(descriptor=DescriptorConfig(method='scan_context'))


@pytest.fixture
def start() -> Iterator[Callable[[], SearchProcess]]:
    processes: list[SearchProcess] = []

    def started() -> SearchProcess:
        processes.append(SearchProcess(SETTINGS))
        return processes[-1]

    yield started
    for process in processes:
        process.close()
        process.close()  # twice is once


@pytest.fixture(scope='module')
def sweeps() -> list[Sweep]:
    """Keyframes' sweeps of a drive that comes back, odometry exact, some positions of a graph."""
    truth = street().truth()
    selector = KeyframeSelector(KeyframeConfig(distance=14.0, angle=3.1))
    chosen: list[Sweep] = []
    for index, T in enumerate(truth.T_world_body):
        if selector.due(T):
            selector.take(T)
            pose = StampedPose(int(truth.stamps_ns[index]), T, np.eye(6) * 1e-4 * (1 + index))
            known = [sweep.pose.T_odom_base[:3, 3] for sweep in chosen]
            graph = GraphPositions(np.arange(len(known)), np.array(known).reshape(-1, 3))
            chosen.append(Sweep(pose, view(index).cloud, T_BASE_LIDAR[:3, 3], graph))
    return chosen


def _here(sweeps: list[Sweep], session: Session) -> list[tuple[Keyframe, list[Any]]]:
    search = LoopSearch(SETTINGS, lambda stage: nullcontext())
    found = []
    for sweep in sweeps:
        keyframe = search.keyframe(session, sweep.pose, sweep.cloud)
        assert keyframe is not None
        job = SearchJob(session, keyframe, sweep.sensor_origin, sweep.graph)
        found.append((keyframe, search.run(job)))
    return found


def _there(process: SearchProcess, session: Session, sweeps: list[Sweep]) -> list[Found]:
    found = []
    for sweep in sweeps:
        process.hand_over(session, sweep)
        result = process.result()
        assert result is not None
        found.append(result)
    return found


def _same(one: Any, other: Any) -> None:
    """Compare dataclasses of arrays to the last bit."""
    assert type(one) is type(other)
    for field in fields(one):
        mine, its = getattr(one, field.name), getattr(other, field.name)
        if isinstance(mine, PointCloud):
            _same(mine, its)
        else:
            np.testing.assert_array_equal(mine, its)


def test_it_finds_what_the_search_finds_here(
    start: Callable[[], SearchProcess], sweeps: list[Sweep]
) -> None:
    process = start()
    assert process.result() is None
    there, here = _there(process, Session(), sweeps), _here(sweeps, Session())
    for result, (keyframe, loops) in zip(there, here, strict=True):
        assert result.keyframe is not None and not result.failed and not result.refused
        _same(result.keyframe, replace(keyframe, features=None))
        assert len(result.loops) == len(loops)
        for mine, its in zip(result.loops, loops, strict=True):
            _same(mine, its)
    assert sum(loop.accepted for result in there for loop in result.loops) >= 5
    assert [result.size for result in there] == list(range(1, len(sweeps) + 1))
    stages = {stage for result in there for stage, seconds in result.times if seconds > 0}
    assert stages == {'reduce', 'describe', 'retrieve', 'search', 'register', 'refine', 'verify'}
    assert [stage for stage, _ in there[0].times].count('search') == 1


def test_a_new_session_forgets_or_goes_on_from_a_loaded_map(
    start: Callable[[], SearchProcess], sweeps: list[Sweep]
) -> None:
    process = start()
    first = _there(process, Session(), sweeps[:4])
    assert [found.keyframe.id for found in first if found.keyframe] == [0, 1, 2, 3]
    again = _there(process, Session(), [replace(sweeps[0], graph=None)])
    assert again[0].keyframe is not None and again[0].keyframe.id == 0
    assert again[0].loops == () and again[0].size == 1
    loaded = tuple(keyframe for keyframe, _ in _here(sweeps[:4], Session()))
    session = Session(loaded)
    going_on = _there(process, session, [replace(sweeps[2], graph=None), sweeps[3]])
    assert [found.keyframe.id for found in going_on if found.keyframe] == [4, 5]
    assert [loop.match_id for loop in going_on[0].loops if loop.accepted] == [2]
    assert going_on[1].size == 6


def test_bad_sweeps_are_said_and_the_child_lives_on(
    start: Callable[[], SearchProcess], sweeps: list[Sweep]
) -> None:
    process, session = start(), Session()
    empty = replace(sweeps[0], cloud=PointCloud(np.empty((0, 3), np.float32)))
    broken = replace(sweeps[0], graph='nowhere')  # type: ignore[arg-type]
    nothing, failed, good = _there(process, session, [empty, broken, sweeps[0]])
    assert nothing.keyframe is None and not nothing.failed
    assert failed.keyframe is not None and 'Error' in failed.failed and failed.loops == ()
    assert good.keyframe is not None and good.keyframe.id == 1


def test_one_sweep_at_a_time(start: Callable[[], SearchProcess], sweeps: list[Sweep]) -> None:
    process, session = start(), Session()
    process.hand_over(session, sweeps[0])
    with pytest.raises(ValueError, match='not taken'):
        process.hand_over(session, sweeps[1])
    found = process.result()
    assert found is not None and found.keyframe is not None and found.keyframe.id == 0
    assert process.result() is None


def test_a_wait_that_was_interrupted_can_be_taken_up_again(
    start: Callable[[], SearchProcess], sweeps: list[Sweep], monkeypatch: pytest.MonkeyPatch
) -> None:
    process = start()
    process.hand_over(Session(), sweeps[0])

    def interrupted(timeout: float | None) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(process._connection, 'poll', interrupted)
        with pytest.raises(KeyboardInterrupt):
            process.result()
    found = process.result()
    assert found is not None and found.keyframe is not None


def test_a_message_cut_in_the_middle_ends_the_child(
    start: Callable[[], SearchProcess], sweeps: list[Sweep], monkeypatch: pytest.MonkeyPatch
) -> None:
    process, session = start(), Session()
    process.hand_over(session, sweeps[0])
    child = process._child
    assert child is not None

    def cut() -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(process._connection, 'recv', cut)
        with pytest.raises(KeyboardInterrupt):
            process.result()
    assert child.returncode is not None
    assert process.result() is None
    with pytest.raises(SearchProcessError, match='has ended'):
        process.hand_over(session, sweeps[1])


def test_a_killed_child_is_said(start: Callable[[], SearchProcess], sweeps: list[Sweep]) -> None:
    process, session = start(), Session()
    _there(process, session, sweeps[:1])
    child = process._child
    assert child is not None
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    process.hand_over(session, sweeps[1])  # nobody knows yet
    with pytest.raises(SearchProcessError, match=r'status -9.*drive again'):
        process.result()


def test_a_search_that_cannot_be_made_is_said_as_here(tmp_path: Path) -> None:
    missing = LcdnetDescriptorConfig(weights=str(tmp_path / 'none.safetensors'))
    with pytest.raises(ConfigError, match='expected the weights of LCDNet'):
        SearchProcess(LoopDetectorSettings(lcdnet=missing))


def test_the_child_ends_when_its_parent_is_killed() -> None:
    code = (
        'import time\n'
        'from lcd_loop_closure.descriptor_choice import DescriptorConfig\n'
        'from lcd_loop_closure.loop_detector import LoopDetectorSettings\n'
        'from lcd_loop_closure.search_process import SearchProcess\n'
        'choice = DescriptorConfig(method="scan_context")\n'
        'process = SearchProcess(LoopDetectorSettings(descriptor=choice))\n'
        'print(process._child.pid, flush=True)\n'
        'time.sleep(60)\n'
    )
    assert ends_with_its_parent(code)
