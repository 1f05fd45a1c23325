"""Clouds of distances alone, or of directions alone, become half points."""

from __future__ import annotations

import numpy as np
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.events import AZIMUTH, AZIMUTH_RANGE, BEARING, POINT, RANGE
from slam_observer_ros.messages.clouds import decode_point_cloud2


def decoded(**columns):
    """Return what comes of a cloud with such fields."""
    dtype = [(name, values.dtype.str[1:]) for name, values in columns.items()]
    records = np.zeros((1, len(columns['x' if 'x' in columns else 'range'])), dtype)
    for name, values in columns.items():
        records[name] = values
    return decode_point_cloud2(ros.serialise(ros.point_cloud2(records)))


IDS = np.array([3, 7], np.uint32)


def test_a_range_is_a_line_of_sight_of_that_length():
    event = decoded(id=IDS, range=np.array([2.5, 40.0]), range_variance=np.array([0.01, 0.04]))
    assert event.ids.tolist() == [3, 7]
    assert event.kinds.tolist() == [RANGE, RANGE]
    assert np.linalg.norm(event.lines_of_sight, axis=1).tolist() == [2.5, 40.0]
    assert event.covariances[:, 0, 0].tolist() == [0.01, 0.04]


@pytest.mark.parametrize('bad', [np.nan, np.inf, 0.0, -1.0])
def test_a_range_that_is_none_is_left_out(bad):
    event = decoded(id=IDS, range=np.array([bad, 4.0]))
    assert event.ids.tolist() == [7]
    assert event.covariances is None


def test_points_without_a_range_are_unit_vectors():
    x, y, z = np.array([[3.0, 1.0], [4.0, 2.0], [0.0, 2.0]])
    event = decoded(id=IDS, x=x, y=y, z=z, no_range=np.array([1, 0], np.uint8))
    assert event.kinds.tolist() == [BEARING, POINT]
    np.testing.assert_allclose(event.points, [[0.6, 0.8, 0.0], [1.0, 2.0, 2.0]])


def test_ranges_without_ids_are_refused():
    with pytest.raises(MessageError, match='known transmitters only'):
        decoded(range=np.array([2.5, 40.0]))


COVARIANCES = np.array([np.diag([0.04, 0.01, 0.01]), np.diag([0.09, 0.01, 0.01])])


@pytest.mark.parametrize('covariances', [None, COVARIANCES])
@pytest.mark.parametrize('kinds', [[RANGE, RANGE], [BEARING, BEARING], [BEARING, POINT]])
def test_what_is_recorded_is_read_again(kinds, covariances):
    points = np.array([[0.5, 0.0, 0.0], [4.0, 0.0, 0.0]])
    points[np.array(kinds) == BEARING] = [1.0, 0.0, 0.0]
    cloud = ros.OUTGOING.point_cloud2(
        ros.STAMP_NS, 'mast', IDS.astype(np.int64), points, covariances, kinds=np.array(kinds)
    )
    event = decode_point_cloud2(ros.serialise(cloud))
    assert event.ids.tolist() == [3, 7]
    assert event.kinds.tolist() == kinds
    np.testing.assert_allclose(event.lines_of_sight, points)
    if covariances is None:
        assert event.covariances is None
    else:
        np.testing.assert_allclose(event.covariances[:, 0, 0], [0.04, 0.09], rtol=1e-6)


@pytest.mark.parametrize('kinds', [[RANGE, POINT], [AZIMUTH, BEARING], [AZIMUTH_RANGE] * 2])
def test_what_a_cloud_has_no_fields_for_is_not_recorded(kinds):
    points = np.ones((2, 3))
    with pytest.raises(MessageError, match='no fields for ranges or azimuths'):
        ros.OUTGOING.point_cloud2(0, '', IDS.astype(np.int64), points, kinds=np.array(kinds))
