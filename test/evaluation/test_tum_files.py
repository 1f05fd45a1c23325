"""TUM files as all kinds of programs write them; what is none is refused by file and line."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.evaluation.trajectory import read_tum
from slam_observer_ros.geometry import so3

HALF = 0.5**0.5
SECOND_NS = 10**9
PLAIN = f'1.5 1 2 3 0 0 {HALF} {HALF}\n2.5 4 5 6 0 0 0 1\n'


def read(tmp_path, content):
    path = tmp_path / 'other.tum'
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_tum(path)


@pytest.mark.parametrize(
    'content',
    [
        PLAIN,
        'timestamp x y z qx qy qz qw\n' + PLAIN,
        '#timestamp tx ty tz qx qy qz qw\n' + PLAIN,
        '# written by ORB_SLAM3, w x y z\n\n' + PLAIN,
        'timestamp,x,y,z,qx,qy,qz,qw\n' + PLAIN.replace(' ', ','),
        PLAIN.replace(' ', '\t'),
        PLAIN.replace(' ', ', ').replace('\n', '\r\n'),
        PLAIN.replace('.', ',').replace(' ', ';'),
        f'timestamp tx ty tz qw qx qy qz\n1.5 1 2 3 {HALF} 0 0 {HALF}\n2.5 4 5 6 1 0 0 0\n',
        f'# t x y z qw qx qy qz\n1.5 1 2 3 {HALF} 0 0 {HALF}\n2.5 4 5 6 1 0 0 0\n',
        PLAIN.encode('utf-8-sig'),
        PLAIN.encode('utf-16'),
        ('# Straße\n' + PLAIN).encode('latin-1'),
    ],
)
def test_poses_are_read_whatever_wrote_them(tmp_path, content):
    read_poses = read(tmp_path, content)
    assert_array_equal(read_poses.stamps_ns, [1_500_000_000, 2_500_000_000])
    assert_allclose(read_poses.positions, [[1, 2, 3], [4, 5, 6]])
    expected = [so3.exp(np.array([0, 0, np.pi / 2])), np.eye(3)]
    assert_allclose(read_poses.rotations, expected, atol=1e-12)


@pytest.mark.parametrize('unit_ns', [1, 10**3, 10**6, 10**9])
def test_stamps_that_no_clock_has_in_seconds_are_in_smaller_units(tmp_path, unit_ns):
    stamps = [(1_700_000_000 + k) * SECOND_NS // unit_ns for k in range(3)]
    poses = read(tmp_path, ''.join(f'{stamp} 0 0 0 0 0 0 1\n' for stamp in stamps))
    assert_array_equal(poses.stamps_ns, (1_700_000_000 + np.arange(3)) * SECOND_NS)


ROW = ' 0 0 0 0 0 0 1\n'


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        (f'1.0{ROW}1.0{ROW}2.0{ROW}', 'line 2 has the same stamp as line 1'),
        (f'# x\n2.0{ROW}\n1.0{ROW}', 'line 4 has an earlier stamp than line 2'),
        (f'1.0{ROW}2.0 0 0 nan 0 0 0 1\n', 'line 2 has a number that is not finite'),
        (f'1.0{ROW}nan{ROW}', 'line 2 has a number that is not finite, or no time'),
        (f'1.0{ROW}1e40{ROW}', 'line 2 has a number that is not finite, or no time'),
        (f'1.0{ROW}2.0 0 0 x 0 0 0 1\n', 'line 2 has not 8 numbers'),
        (f'1.0{ROW}2.0 0 0\n', 'line 2 has not 8 numbers'),
        (f'1.0{ROW}2.0 0 0 0 0 0 0 0\n', 'line 2: a quaternion is zero'),
        ('1 0 0 0 0 1 0 0 0 0 1 0\n', 'line 1 has not 8 numbers'),  # KITTI
        ('once upon a time\n', 'line 1 has not 8 numbers'),
        ('# timestamp x y z qx qy qz qw\n', 'there are no poses in it'),
        ('', 'there are no poses in it'),
    ],
)
def test_what_is_no_trajectory_is_refused_by_file_and_line(tmp_path, content, reason):
    with pytest.raises(EvaluationError) as caught:
        read(tmp_path, content)
    assert str(caught.value).startswith(f'{tmp_path / "other.tum"}: no TUM file: {reason}')
