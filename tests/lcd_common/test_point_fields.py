"""PointCloud2 bytes: every layout that drivers write, and the ones that must be refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.point_fields import cloud_from_fields, layout

STAMP = 1_700_000_000_000_000_000
CODES = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}


def message(points: np.ndarray, height: int = 1, padding: int = 0, **changes: object):
    """Lay a structured array out as a PointCloud2 of `height` rows with `padding` bytes each."""
    dtype = points.dtype
    assert dtype.names and dtype.fields
    width = len(points) // height
    rows = points.reshape(height, width).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    values = dict(
        fields=[
            SimpleNamespace(
                name=name,
                offset=dtype.fields[name][1],
                datatype=CODES[dtype[name].str[1:]],
                count=1,
            )
            for name in dtype.names
        ],
        is_bigendian=dtype[0].str[0] == '>',
        point_step=dtype.itemsize,
        row_step=rows.shape[1],
        height=height,
        width=width,
        data=rows.tobytes(),
    )
    return SimpleNamespace(**(values | changes))


def points(n: int = 12, order: str = '<', **extra: str) -> np.ndarray:
    dtype = [(axis, order + 'f4') for axis in 'xyz'] + [(k, order + v) for k, v in extra.items()]
    out = np.zeros(n, dtype)
    for number, name in enumerate(dtype):
        out[name[0]] = np.arange(n) + 100 * number
    return out


def test_padded_rows_and_gaps_between_fields() -> None:
    dtype = np.dtype(
        {
            'names': ['x', 'y', 'z', 'ring'],
            'formats': ['<f4', '<f4', '<f4', '<u2'],
            'offsets': [0, 8, 4, 20],
            'itemsize': 32,
        }
    )
    array = np.zeros(12, dtype)
    array['x'], array['y'], array['z'] = np.arange(12), 2 * np.arange(12), 3 * np.arange(12)
    for height, padding in [(1, 0), (3, 0), (3, 7), (4, 64)]:
        cloud = cloud_from_fields(message(array, height, padding), STAMP)
        np.testing.assert_array_equal(cloud.xyz, np.c_[array['x'], array['y'], array['z']])
        assert cloud.intensity is None and cloud.time_s is None


def test_big_endian_doubles() -> None:
    array = np.zeros(5, [(axis, '>f8') for axis in 'xyz'])
    array['y'] = np.arange(5) + 0.5
    np.testing.assert_array_equal(
        cloud_from_fields(message(array), STAMP).xyz[:, 1], np.arange(5) + 0.5
    )


@pytest.mark.parametrize(
    ('name', 'dtype', 'value'),
    [
        ('t', 'u4', lambda s: s * 1e9),
        ('offset_time', 'u4', lambda s: s * 1e9),
        ('time', 'f4', lambda s: s),
        ('time_offset', 'f4', lambda s: s),
        ('timestamp', 'f8', lambda s: s + STAMP * 1e-9),
        ('timestamp', 'f8', lambda s: s * 1e9 + STAMP),
        ('time', 'f4', lambda s: s * 1e6),
    ],
)
def test_point_time_in_the_units_of_drivers(name: str, dtype: str, value) -> None:
    seconds = np.linspace(0, 0.1, 12)
    array = points(12, **{name: dtype})
    array[name] = value(seconds)
    cloud = cloud_from_fields(message(array), STAMP)
    assert cloud.time_s is not None
    np.testing.assert_allclose(cloud.time_s, seconds, atol=1e-6)


def test_time_is_not_invented() -> None:
    array = points(12, time='f4')
    array['time'] = 0.0
    assert cloud_from_fields(message(array), STAMP).time_s is None


def test_no_points_is_an_empty_cloud() -> None:
    assert len(cloud_from_fields(message(points(0)), STAMP)) == 0


@pytest.mark.parametrize(
    ('broken', 'text'),
    [
        (message(points()[['x', 'y']].copy()), 'must have the fields x, y and z'),
        (message(points(), data=b'123'), 'promises 1 rows of 12 points of 12 bytes, got 3 bytes'),
        (message(points(), point_step=4), 'impossible layout'),
        (message(points(), height=2, row_step=10), 'row_step 10'),
    ],
)
def test_impossible_clouds_are_refused(broken: object, text: str) -> None:
    with pytest.raises(DataError, match=text):
        cloud_from_fields(broken, STAMP)


def test_layout_round_trip() -> None:
    rng = np.random.default_rng(0)
    cloud = PointCloud(
        rng.normal(size=(9, 3)).astype(np.float32),
        rng.uniform(size=9).astype(np.float32),
        np.linspace(-0.1, 0, 9, dtype=np.float32),
    )
    array, fields = layout(cloud)
    assert [name for name, _, _ in fields] == ['x', 'y', 'z', 'intensity', 'time']
    back = cloud_from_fields(message(array), STAMP)
    np.testing.assert_array_equal(back.xyz, cloud.xyz)
    np.testing.assert_array_equal(back.intensity, cloud.intensity)
    np.testing.assert_allclose(back.time_s, cloud.time_s, atol=1e-7)


def test_labels_come_back_as_they_went() -> None:
    cloud = PointCloud(
        np.ones((3, 3), np.float32), time_s=np.array([0.0, 0.1, 0.2], np.float32),
        label=np.array([40, 252, 259], np.uint16),
    )  # fmt: skip
    rows, fields = layout(cloud)
    assert fields[-1] == ('label', 16, 6) and rows.dtype.itemsize == 20
    back = cloud_from_fields(message(rows), STAMP)
    np.testing.assert_array_equal(back.label, cloud.label)
    np.testing.assert_array_equal(back.moving, [False, True, True])
    np.testing.assert_array_equal(back.select(np.array([2])).label, [259])
    # Other people's field of that name may hold anything.
    assert cloud_from_fields(message(points(label='f4')), STAMP).label is None
    instances = points(label='u4')
    instances['label'] = 10 | (7 << 16)
    assert set(cloud_from_fields(message(instances), STAMP).label) == {10}
