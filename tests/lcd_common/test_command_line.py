"""Known mistakes end in one line and status 1; defects keep their traceback."""

import pytest

from lcd_common import command_line
from lcd_common.errors import DataError


def raising(error: BaseException) -> int:
    raise error


def test_statuses(capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.run(lambda: None) == 0
    assert command_line.run(lambda: 3) == 3
    assert command_line.run(lambda: raising(DataError('x.bin: expected 16 bytes a point'))) == 1
    assert capsys.readouterr().err == 'error: x.bin: expected 16 bytes a point\n'
    missing = FileNotFoundError(2, 'No such file or directory', 'a.bag')
    assert command_line.run(lambda: raising(missing)) == 1
    assert capsys.readouterr().err == 'error: a.bag: No such file or directory\n'
    assert command_line.run(lambda: raising(KeyboardInterrupt())) == 130
    with pytest.raises(ZeroDivisionError):
        command_line.run(lambda: raising(ZeroDivisionError()))
