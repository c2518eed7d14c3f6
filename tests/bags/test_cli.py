"""The commands, as a user types them."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from bags.cli import main

SMALL = ['--columns', '16']


def counts(path: Path) -> dict[str, int]:
    with AnyReader([path]) as reader:
        return {c.topic: c.msgcount for c in reader.connections}


def test_convert_writes_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'street'
    arguments = ['convert', 'street', '--out', str(out), '--start', '1', '--duration', '2', *SMALL]
    assert main(arguments) == 0
    assert counts(out) == {
        '/tf_static': 1,
        '/points': 21,
        '/imu': 201,
        '/gps/fix': 3,
        '/ground_truth/pose': 21,
    }
    assert f'{out}: /tf_static 1' in capsys.readouterr().out


def test_a_bag_converted_again_is_the_same_bag(tmp_path: Path) -> None:
    first, second = tmp_path / 'first.mcap', tmp_path / 'second.mcap'
    span = ['--duration', '1', '--quiet']
    assert main(['convert', 'street', '--out', str(first), *SMALL, *span]) == 0
    assert main(['convert', str(first), '--out', str(second), '--quiet']) == 0
    contents = []
    for path in (first, second):
        with AnyReader([path]) as reader:
            found = sorted((c.topic, t, bytes(d)) for c, t, d in reader.messages())
            # A rotation that went through its matrix may differ in its quaternion's last bit.
            rotated = ('/ground_truth/pose', '/tf_static')
            contents.append([(m[0], m[1], len(m[2])) if m[0] in rotated else m for m in found])
    assert contents[0] == contents[1]


@pytest.mark.parametrize(
    ('flags', 'topics'),
    [
        (['--points-only'], {'/tf_static', '/points'}),
        (['--no-truth'], {'/tf_static', '/points', '/imu', '/gps/fix'}),
        (['--no-images'], {'/tf_static', '/points', '/imu', '/gps/fix', '/ground_truth/pose'}),
    ],
)
def test_streams_can_be_left_out(tmp_path: Path, flags: list[str], topics: set[str]) -> None:
    out = tmp_path / 'street.mcap'
    arguments = ['convert', 'street', '--out', str(out), '--duration', '0.2', '--quiet']
    assert main([*arguments, *SMALL, *flags]) == 0
    assert set(counts(out)) == topics


def test_images_and_calibration_of_a_data_set_arrive(tmp_path: Path, kitti) -> None:  # type: ignore[no-untyped-def]
    folder = kitti(numbers=range(3), images=range(3))
    out = tmp_path / 'kitti'
    assert main(['convert', str(folder), '--out', str(out), '--quiet']) == 0
    found = counts(out)
    assert found['/camera/image'] == found['/camera/camera_info'] == found['/points'] == 3


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['convert', 'nowhere', '--out', 'x'], 'nowhere: nothing there'),
        (['convert', 'street:up', '--out', 'x'], 'one of loop, abrupt_u_turn'),
        (['convert', 'street', '--out', 'x', '--start', '1000'], 'must lie within'),
        (['convert', 'street', '--out', 'x', '--columns', '2'], 'at least 16'),
        (['convert', 'street', '--out', '/nowhere/x'], 'does not exist; create it'),
        (['info', 'nowhere'], 'nowhere: nothing there'),
        (['info', 'x', '--topic', 'points'], 'ROLE=TOPIC'),
        (['play', 'nowhere'], 'nowhere: nothing there'),
        (['play', 'street', '--loop', '-1'], 'number of rounds'),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert error.startswith('error: ') and error.count('\n') == 1 and message in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    'arguments', [[], ['convert', 'street'], ['play', 'street', '--rate', '0']]
)
def test_wrong_usage_ends_with_status_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2


@pytest.mark.parametrize('command', [[], ['convert'], ['info'], ['play']])
def test_help_shows_worked_examples(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main([*command, '--help'])
    assert exit_.value.code == 0
    assert f'bags {"".join(command) or "info"} ' in capsys.readouterr().out.split('examples:')[1]


def test_info_tells_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'street'
    main(['convert', 'street', '--out', str(out), '--duration', '1', '--quiet', *SMALL])
    again = ['--duration', '1', '--quiet', '--point-time', '--points-only', *SMALL]
    main(['convert', 'street', '--out', f'{out}2', *again])
    capsys.readouterr()
    assert main(['info', str(out)]) == 0
    text = ' '.join(capsys.readouterr().out.split())
    for expected in (
        '/points sensor_msgs/msg/PointCloud2 11 10.00 Hz',
        'base_link -> lidar: 0.000 0.000 1.730, 0.00 0.00 0.00',
        'x y z intensity, no time per point',
        'truth 11 poses',
        'skipped nothing',
        '1.0 s',
    ):
        assert expected in text
    assert main(['info', f'{out}2', '--full']) == 0
    text = capsys.readouterr().out
    assert 'intensity, time 0.0000 to 0.09' in text and 'in all of it' in text
    assert 'truth     none' in text


def test_info_counts_what_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'a.mcap'
    main(['convert', 'street', '--out', str(out), '--duration', '3', '--quiet', *SMALL])
    data = out.read_bytes()
    out.write_bytes(data[: len(data) // 2])
    capsys.readouterr()
    assert main(['info', str(out), '--full']) == 0
    assert '1 x bag cut off' in capsys.readouterr().out


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_convert_leaves_nothing(tmp_path: Path, how: signal.Signals) -> None:
    process = subprocess.Popen(
        [
            *(sys.executable, '-c', 'from bags.cli import main; raise SystemExit(main())'),
            *('convert', 'street', '--out', str(tmp_path / 'x'), '--columns', '2000'),
        ],
        stderr=subprocess.PIPE,
        text=True,
        # A shell's background jobs ignore Ctrl-C, and so would their children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None
    seen = ''
    while '1/' not in seen:  # the bar has moved: the bag is being written
        seen += process.stderr.read(1)
    assert [p.name.startswith('.x.partial') for p in tmp_path.iterdir()] == [True]
    process.send_signal(how)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130 and 'interrupted' in error and 'Traceback' not in error
    assert list(tmp_path.iterdir()) == []
