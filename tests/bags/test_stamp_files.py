"""Files of stamps."""

from datetime import UTC, datetime

import numpy as np
import pytest

from bags.skips import Skips
from bags.stamp_files import read_date_stamps, read_stamped_rows, stamps_of_numbers
from lcd_common.errors import DataError


def test_dates_are_read_to_the_nanosecond(tmp_path):
    path = tmp_path / 'timestamps.txt'
    path.write_text('2011-09-26 13:02:25.964389445\n\nno date\n2011-12-31 23:59:59.000000001\n\n\n')
    seconds = int(datetime(2011, 9, 26, 13, 2, 25, tzinfo=UTC).timestamp())
    last = int(datetime(2011, 12, 31, 23, 59, 59, tzinfo=UTC).timestamp())
    expected = [seconds * 10**9 + 964_389_445, None, None, last * 10**9 + 1]
    assert read_date_stamps(path) == expected


@pytest.mark.parametrize('text', ['', '\n\n', 'nothing\n'])
def test_file_without_dates_is_an_error(tmp_path, text):
    path = tmp_path / 'timestamps.txt'
    path.write_text(text)
    with pytest.raises(DataError, match=r'timestamps\.txt: expected lines like'):
        read_date_stamps(path)


def test_missing_file_is_an_error(tmp_path):
    with pytest.raises(DataError, match=r'timestamps\.txt: missing'):
        read_date_stamps(tmp_path / 'timestamps.txt')


@pytest.mark.parametrize(
    ('numbers', 'lines', 'expected'),
    [
        ([0, 1, 2], [10, 11, 12], {0: 10, 1: 11, 2: 12}),
        ([0, 2], [10, 11, 12], {0: 10, 2: 12}),
        ([0, 2], [10, None, 12], {0: 10, 2: 12}),
        ([0, 1, 2], [10, None, 11, None, 12], {0: 10, 1: 11, 2: 12}),  # stray lines
        ([0, 1, 2], [10, None, 12], {0: 10, 2: 12}),
        ([0, 1, 2], [10, 11], {0: 10, 1: 11}),
    ],
)
def test_line_numbers_are_file_numbers(tmp_path, numbers, lines, expected):
    skips = Skips()
    assert stamps_of_numbers(numbers, lines, tmp_path / 'timestamps.txt', skips) == expected
    assert sum(skips.counts.values()) == len(numbers) - len(expected)


def test_rows_keep_their_integer_stamps(tmp_path):
    path = tmp_path / 'x.csv'
    stamp = 1_561_000_444_390_857_631  # no float holds it
    path.write_text(f'{stamp},1.5,2\n{stamp + 1},3,4\n{stamp},1\nx,1,2\n{stamp},inf,2\n')
    skips = Skips()
    stamps, rows = read_stamped_rows(path, 3, skips)
    assert stamps.tolist() == [stamp, stamp + 1]
    assert np.array_equal(rows, [[1.5, 2], [3, 4]])
    assert skips.counts == {'broken row of x.csv': 3}
