"""Transforms between frames: chains, interpolation, limits in time; events moved by them."""

from __future__ import annotations

from hypothesis import given
import hypothesis.strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest
import ros_messages as ros
from strategies import poses

from slam_observer_ros.common.errors import TransformError
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.poses import decode_transforms
from slam_observer_ros.recordings.frames import (
    ALWAYS_NS,
    HISTORY_NS,
    insert_transforms,
    TransformBuffer,
)

NO_TURN = [0.0, 0.0, 0.0, 1.0]
SECOND = 1_000_000_000


@given(poses(), poses(), poses())
def test_lookup_goes_up_one_branch_and_down_the_other(base, left, right):
    buffer = TransformBuffer()
    buffer.insert('odom', 'base', SECOND, base)
    buffer.insert('base', 'left', 0, left, is_static=True)
    buffer.insert('/base', '/right', 0, right, is_static=True)
    assert_allclose(buffer.lookup('odom', 'left', SECOND), base @ left, atol=1e-12)
    assert_allclose(
        buffer.lookup('right', 'left', 5 * SECOND), se3.inverse(right) @ left, atol=1e-12
    )
    assert_allclose(buffer.lookup('base', 'base', 0), np.eye(4))


@given(st.floats(0.0, 1.0))
def test_dynamic_transforms_are_interpolated(share):
    buffer = TransformBuffer()
    xi = np.array([0.0, 0.0, 1.2, 0.0, 0.0, 0.0])
    shift = np.array([2.0, 0.0, 0.0])
    end = se3.pose(se3.exp(xi)[:3, :3], shift)
    buffer.insert('odom', 'base', 2 * SECOND, end)
    buffer.insert('odom', 'base', SECOND, np.eye(4))  # out of order
    found = buffer.lookup('odom', 'base', SECOND + round(share * SECOND))
    assert_allclose(found[:3, 3], share * shift, atol=1e-8)
    assert_allclose(found[:3, :3], se3.exp(share * xi)[:3, :3], atol=1e-8)


@given(st.booleans())
def test_of_a_fiducial_that_two_cameras_see_each_has_its_own_transform(at_once):
    """Both name the same frame, which /tf gives one parent: whoever came last."""
    buffer = TransformBuffer()
    later_ns = SECOND + (0 if at_once else SECOND // 20)
    for stamp_ns in (0, 1, 2):
        for camera, seen_ns, x in (('left', SECOND, 1.0), ('right', later_ns, 2.0)):
            pose = se3.exp(np.array([0.0, 0.0, 0.3, x + stamp_ns, 0.0, 0.0]))
            buffer.insert(camera, 'tag36h11:1', seen_ns + stamp_ns, pose)
    left = buffer.lookup_child('left', 'tag36h11:1', SECOND + 1)
    right = buffer.lookup_child('right', 'tag36h11:1', later_ns + 1)
    assert_allclose(left, se3.exp(np.array([0.0, 0.0, 0.3, 2.0, 0.0, 0.0])))
    assert_allclose(right, se3.exp(np.array([0.0, 0.0, 0.3, 3.0, 0.0, 0.0])))


def test_nothing_is_extrapolated_and_old_transforms_are_forgotten():
    buffer = TransformBuffer()
    buffer.insert('odom', 'base', SECOND, np.eye(4))
    for stamp_ns in (SECOND - 1, SECOND + 1):
        with pytest.raises(TransformError, match=r"'odom' to 'base' is known from 1\.000"):
            buffer.lookup('odom', 'base', stamp_ns)
    buffer.insert('odom', 'base', 2 * SECOND + HISTORY_NS, np.eye(4))
    with pytest.raises(TransformError):
        buffer.lookup('odom', 'base', SECOND)


def test_the_newest_stamp_of_a_chain_is_that_of_its_oldest_link():
    buffer = TransformBuffer()
    buffer.insert('odom', 'base', 3 * SECOND, np.eye(4))
    buffer.insert('base', 'turret', 2 * SECOND, np.eye(4))
    buffer.insert('turret', 'camera', 0, np.eye(4), is_static=True)
    assert buffer.newest_ns('odom', 'base') == 3 * SECOND
    assert buffer.newest_ns('/odom', 'camera') == buffer.newest_ns('camera', 'odom') == 2 * SECOND
    assert buffer.newest_ns('turret', 'camera') == ALWAYS_NS
    assert buffer.newest_ns('map', 'base') is None


def test_unconnected_frames_and_loops_are_errors():
    buffer = TransformBuffer()
    buffer.insert('map', 'base', 0, np.eye(4), is_static=True)
    with pytest.raises(TransformError, match="'camera' and 'base' are not connected"):
        buffer.lookup('base', 'camera', 0)
    buffer.insert('a', 'b', 0, np.eye(4), is_static=True)
    buffer.insert('b', 'a', 0, np.eye(4), is_static=True)
    with pytest.raises(TransformError, match='its own ancestor'):
        buffer.lookup('a', 'map', 0)


def test_a_new_parent_and_a_later_message_with_one_stamp_replace_what_was_known():
    buffer = TransformBuffer()
    moved = se3.pose(np.eye(3), np.ones(3))
    buffer.insert('old', 'base', SECOND, np.eye(4))
    buffer.insert('new', 'base', SECOND, np.eye(4))
    buffer.insert('new', 'base', SECOND, moved)
    assert_allclose(buffer.lookup('new', 'base', SECOND), moved)
    with pytest.raises(TransformError):
        buffer.lookup('old', 'base', SECOND)


def test_what_was_replaced_takes_no_part_in_what_lies_between():
    buffer, moved = TransformBuffer(), se3.pose(np.eye(3), np.ones(3))
    for stamp_ns, pose in ((SECOND, np.eye(4)), (SECOND, moved), (2 * SECOND, moved)):
        buffer.insert('odom', 'base', stamp_ns, pose)
    assert_allclose(buffer.lookup('odom', 'base', SECOND * 3 // 2), moved)


def test_of_static_transforms_the_last_one_given_holds_whatever_its_stamp():
    buffer = TransformBuffer()
    for stamp_ns in (5 * SECOND, 7 * SECOND, 3 * SECOND):
        placed = se3.pose(np.eye(3), np.full(3, 1e-9 * stamp_ns))
        buffer.insert('base', 'camera', stamp_ns, placed, is_static=True)
        assert_allclose(buffer.lookup('base', 'camera', 0), placed)


@pytest.mark.parametrize(
    ('position', 'quaternion', 'reason'),
    [
        ([1.0, 2.0, 3.0], [0.0] * 4, 'quaternion of norm 0, not 1'),
        ([1.0, 2.0, 3.0], [np.nan] * 4, 'quaternion of norm nan'),
        ([np.nan, 2.0, 3.0], NO_TURN, 'a coordinate is NaN or infinite'),
    ],
)
def test_one_bad_transform_of_a_message_is_left_out_and_reported_once(
    caplog, position, quaternion, reason
):
    transforms = [
        ros.transform_stamped(('odom', 'base'), [1.0, 0.0, 0.0], NO_TURN),
        ros.transform_stamped(('base', 'gripper'), position, quaternion),
        ros.transform_stamped(('base', 'camera'), [0.0, 2.0, 0.0], NO_TURN),
    ]
    raw = ros.serialise(ros.make('tf2_msgs/msg/TFMessage', transforms))
    buffer = TransformBuffer()
    for _ in range(3):
        insert_transforms(buffer, decode_transforms(raw), is_static=False)
    found = buffer.lookup('odom', 'camera', ros.STAMP_NS)
    assert_allclose(found[:3, 3], [1.0, 2.0, 0.0])
    with pytest.raises(TransformError, match="'gripper' and 'odom' are not connected"):
        buffer.lookup('odom', 'gripper', ros.STAMP_NS)
    (record,) = caplog.records
    assert f"A transform on /tf of frame 'gripper' is not used: {reason}" in record.getMessage()


def test_a_transform_of_a_frame_to_itself_changes_nothing_and_is_reported_once(caplog):
    buffer = TransformBuffer()
    for _ in range(3):
        buffer.insert('odom', 'base', SECOND, np.eye(4))
        buffer.insert('base', '/base', SECOND, np.eye(4))
    assert_allclose(buffer.lookup('odom', 'base', SECOND), np.eye(4))
    (record,) = caplog.records
    assert "of frame 'base' is not used: it is to the frame itself" in record.getMessage()


def test_after_a_jump_of_the_clock_only_static_transforms_are_left():
    buffer = TransformBuffer()
    buffer.insert('odom', 'base', SECOND, np.eye(4))
    buffer.insert('base', 'camera', 0, np.eye(4), is_static=True)
    buffer.clear()
    buffer.lookup('base', 'camera', 0)
    with pytest.raises(TransformError):
        buffer.lookup('odom', 'base', SECOND)


def test_a_straggler_of_the_lap_before_does_not_make_all_of_the_next_too_old():
    buffer = TransformBuffer()
    buffer.insert('odom', 'base_link', 30 * SECOND, np.eye(4))
    for step in range(20):
        buffer.insert('odom', 'base_link', step * SECOND // 50, np.eye(4))
    assert buffer.newest_ns('odom', 'base_link') == 19 * SECOND // 50
    np.testing.assert_array_equal(buffer.lookup('odom', 'base_link', SECOND // 3), np.eye(4))


def test_one_old_transform_that_is_repeated_is_no_jump():
    buffer = TransformBuffer()
    for stamp_ns in (30 * SECOND, *[5 * SECOND] * 10):
        buffer.insert('odom', 'base_link', stamp_ns, np.eye(4))
    assert buffer.newest_ns('odom', 'base_link') == 30 * SECOND


def test_transforms_that_come_late_among_others_are_kept():
    buffer = TransformBuffer()
    for step in range(10):
        for behind_s in (0, 3):
            buffer.insert('odom', 'base_link', (10 + step - behind_s) * SECOND, np.eye(4))
    assert buffer.newest_ns('odom', 'base_link') == 19 * SECOND
    buffer.lookup('odom', 'base_link', 10 * SECOND)


def test_roll_pitch_and_yaw_turn_about_fixed_axes():
    pose = se3.from_rpy((1.0, 2.0, 3.0, -np.pi / 2, 0.0, -np.pi / 2))  # a camera's optical axes
    assert_allclose(se3.transform(pose, np.array([[0.0, 0.0, 5.0]])), [[6.0, 2.0, 3.0]])


@given(poses(), poses())
def test_a_moved_observation_is_of_the_same_points(sensor, body):
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 2.0]])
    covariances = np.array([np.diag([1.0, 2.0, 3.0])] * 2)
    event = ObservationEvent(0, np.array([1, 2]), points, covariances, points)
    moved = event.moved(sensor)
    world = se3.transform(body @ sensor, points)
    assert_allclose(se3.transform(body, moved.points), world, atol=1e-9)
    back = moved.moved(se3.inverse(sensor))
    assert_allclose(back.covariances, covariances, atol=1e-9)
    assert_allclose(np.linalg.norm(moved.velocities, axis=1), np.linalg.norm(points, axis=1))


@given(poses())
def test_sensor_and_base_move_as_one_body(sensor):
    V = np.array([0.1, -0.2, 0.3, 1.0, 0.5, -0.4])
    moved = VelocityEvent(0, V, np.eye(6)).moved(sensor)
    # Base, then sensor, after one second: the same whichever of the two was carried on.
    assert_allclose(se3.exp(moved.body_velocity) @ sensor, sensor @ se3.exp(V), atol=1e-9)
    assert np.linalg.eigvalsh(moved.covariance).min() > 0.0
