"""ROS messages become arrays unchanged, and malformed ones are refused with the reason."""

from __future__ import annotations

from dataclasses import replace
import struct

import detector_messages as detector
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.estimates import Update
from slam_observer_ros.events import BEARING, IMPOSSIBLE_ID, MAX_ID, POINT, RANGE
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.messages import clouds, poses
from slam_observer_ros.messages.outgoing import (
    encode_point_cloud,
    encode_transform,
    EstimateMessages,
    StateMessages,
    uncertain_pose,
)
from slam_observer_ros.messages.registry import decoders

FINITE = st.floats(-1e6, 1e6)
TWISTS = st.tuples(*[FINITE] * 6)
# Every length, so that each alignment of what follows the string occurs.
FRAMES = st.text('abc/_é', max_size=9)
ENDIANNESS = st.booleans()
COVARIANCE = np.arange(1.0, 37.0).reshape(6, 6)
ANGULAR_FIRST_COVARIANCE = np.block(
    [[COVARIANCE[3:, 3:], COVARIANCE[3:, :3]], [COVARIANCE[:3, 3:], COVARIANCE[:3, :3]]]
)
POINT_TYPE = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', '<u4')])


def records(dtype: np.dtype, shape: tuple[int, int] = (1, 3)) -> np.ndarray:
    """Fill x, y, z, ... with distinct numbers that float32 holds, and id with 7, 8, ..."""
    filled = np.zeros(shape, dtype)
    for offset, name in enumerate(dtype.names):
        start = 7 if name == 'id' else 0.5 + 10 * offset
        filled[name] = start + np.arange(filled.size).reshape(shape)
    return filled


def points_of(cloud: np.ndarray) -> np.ndarray:
    """(n, 3) coordinates of a structured array."""
    return np.stack([cloud[name].ravel() for name in 'xyz'], axis=1).astype(float)


class TestVelocities:
    """Velocities come out angular first, with the frame and time that belong to them."""

    @given(TWISTS, ENDIANNESS)
    def test_twist_has_the_time_of_its_reception(self, velocity, little_endian):
        raw = ros.serialise(ros.twist(velocity), little_endian)
        message = poses.decode_twist(raw, 42)
        assert (message.sensor_frame, message.stamp_ns) == ('', 42)
        np.testing.assert_array_equal(message.body_velocity, velocity)

    @given(TWISTS, FRAMES, ENDIANNESS)
    def test_twist_stamped(self, velocity, frame_id, little_endian):
        raw = ros.serialise(ros.twist_stamped(velocity, frame_id), little_endian)
        message = poses.decode_twist_stamped(raw, 42)
        assert (message.sensor_frame, message.stamp_ns) == (frame_id, ros.STAMP_NS)
        np.testing.assert_array_equal(message.body_velocity, velocity)
        assert message.covariance is None

    @given(TWISTS, FRAMES, ENDIANNESS)
    def test_twist_with_covariance_stamped(self, velocity, frame_id, little_endian):
        twist = ros.make(
            'geometry_msgs/msg/TwistWithCovariance', ros.twist(velocity), COVARIANCE.ravel()
        )
        message_type = 'geometry_msgs/msg/TwistWithCovarianceStamped'
        raw = ros.serialise(ros.make(message_type, ros.header(frame_id), twist), little_endian)
        message = poses.decode_twist_with_covariance_stamped(raw, 42)
        np.testing.assert_array_equal(message.body_velocity, velocity)
        np.testing.assert_array_equal(message.covariance, ANGULAR_FIRST_COVARIANCE)

    @given(TWISTS, FRAMES, FRAMES, ENDIANNESS)
    def test_odometry_twist_is_in_its_child_frame(self, velocity, parent, child, little_endian):
        odometry = ros.odometry(velocity, COVARIANCE, frames=(parent, child))
        raw = ros.serialise(odometry, little_endian)
        message = poses.decode_odometry_twist(raw, 42)
        assert (message.sensor_frame, message.stamp_ns) == (child, ros.STAMP_NS)
        np.testing.assert_array_equal(message.body_velocity, velocity)
        np.testing.assert_array_equal(message.covariance, ANGULAR_FIRST_COVARIANCE)

    def test_odometry_without_a_pose_still_gives_its_twist(self):
        raw = ros.serialise(ros.odometry([1.0] * 6, COVARIANCE, quaternion=[0.0] * 4))
        assert poses.decode_odometry_twist(raw).body_velocity.tolist() == [1.0] * 6

    @pytest.mark.parametrize('first', [0.0, -1.0])
    def test_unknown_covariance_is_none(self, first):
        covariance = np.zeros((6, 6))
        covariance[0, 0] = first
        raw = ros.serialise(ros.odometry([1.0] * 6, covariance))
        assert poses.decode_odometry_twist(raw).covariance is None
        assert poses.decode_odometry_pose(raw).covariance is None

    def imu(self, covariance: np.ndarray) -> bytes:
        return ros.serialise(ros.imu([1.0, 2.0, 3.0], covariance))

    def test_imu_gives_angular_velocity(self):
        covariance = np.arange(1.0, 10.0).reshape(3, 3)
        message = poses.decode_imu(self.imu(covariance))
        assert (message.stamp_ns, message.sensor_frame) == (ros.STAMP_NS, 'imu')
        assert message.angular_velocity.tolist() == [1.0, 2.0, 3.0]
        np.testing.assert_array_equal(message.covariance, covariance)
        assert poses.decode_imu(self.imu(np.zeros((3, 3)))).covariance is None

    def test_imu_without_a_gyroscope_is_refused(self):
        covariance = np.zeros((3, 3))
        covariance[0, 0] = -1.0
        with pytest.raises(MessageError, match='no angular velocity'):
            poses.decode_imu(self.imu(covariance))


class TestPoses:
    """Poses come out as transforms from child frame to frame."""

    POSITION = (1.0, 2.0, 3.0)
    QUATERNION = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    EXPECTED = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])

    @given(FRAMES, ENDIANNESS)
    def test_all_pose_types_give_the_same_transform(self, frame_id, little_endian):
        pose = ros.pose(self.POSITION, self.QUATERNION)
        with_covariance = ros.make(
            'geometry_msgs/msg/PoseWithCovariance', pose, COVARIANCE.ravel()
        )
        header = ros.header(frame_id)
        built = [
            ros.make('geometry_msgs/msg/PoseStamped', header, pose),
            ros.make('geometry_msgs/msg/PoseWithCovarianceStamped', header, with_covariance),
            ros.transform_stamped((frame_id, 'base'), self.POSITION, self.QUATERNION),
            ros.odometry(
                [0.0] * 6, COVARIANCE, self.POSITION, self.QUATERNION, (frame_id, 'base')
            ),
        ]
        assert {message.__msgtype__ for message in built} == set(decoders('pose'))
        for message in built:
            decoded = decoders('pose')[message.__msgtype__](ros.serialise(message, little_endian))
            assert (decoded.stamp_ns, decoded.frame_id) == (ros.STAMP_NS, frame_id)
            assert decoded.child_frame_id == getattr(message, 'child_frame_id', '')
            np.testing.assert_allclose(decoded.pose, self.EXPECTED, atol=1e-15)
            is_uncertain = hasattr(getattr(message, 'pose', None), 'covariance')
            expected = ANGULAR_FIRST_COVARIANCE if is_uncertain else None
            np.testing.assert_equal(decoded.covariance, expected)

    @given(st.lists(st.tuples(FRAMES, FRAMES), max_size=4), ENDIANNESS)
    def test_tf_message(self, frames, little_endian):
        transforms = [ros.transform_stamped(f, self.POSITION, self.QUATERNION) for f in frames]
        # tf2_msgs/TFMessage is one sequence of transforms, as is the transforms field here.
        raw = ros.serialise(ros.make('tf2_msgs/msg/TFMessage', transforms), little_endian)
        decoded = poses.decode_transforms(raw)
        assert [(t.frame_id, t.child_frame_id) for t in decoded] == frames
        for transform in decoded:
            np.testing.assert_allclose(transform.pose, self.EXPECTED, atol=1e-15)

    @pytest.mark.parametrize(
        'quaternion', [[0.0] * 4, [np.nan] * 4, [0.0, 0.0, 0.0, 2.0], [1e200] * 4]
    )
    def test_quaternion_that_is_no_rotation_is_refused(self, quaternion):
        pose = ros.pose(self.POSITION, quaternion)
        raw = ros.serialise(ros.make('geometry_msgs/msg/PoseStamped', ros.header('map'), pose))
        with pytest.raises(MessageError, match='quaternion'):
            poses.decode_pose_stamped(raw)


class TestPointCloud:
    """PointCloud: points from Point32, ids from the channel of that name."""

    @given(
        st.lists(
            st.tuples(st.integers(-1, 2**24 - 1), *[st.floats(-1e3, 1e3, width=32)] * 3),
            max_size=9,
        ),
        FRAMES,
        st.text('abc', max_size=5),
        ENDIANNESS,
    )
    def test_round_trip(self, rows, frame_id, other_channel, little_endian):
        table = np.array(rows, dtype=float).reshape(-1, 4)
        channels = {other_channel: np.zeros(2), 'id': table[:, 0]}
        raw = ros.serialise(ros.point_cloud(table[:, 1:], channels, frame_id), little_endian)
        message = clouds.decode_point_cloud(raw, 42)
        assert (message.sensor_frame, message.stamp_ns) == (frame_id, ros.STAMP_NS)
        np.testing.assert_array_equal(message.ids, table[:, 0])
        np.testing.assert_array_equal(message.points, table[:, 1:])
        assert 'id' in clouds.read_fields(raw, 'sensor_msgs/msg/PointCloud').names

    def test_without_the_channel_all_ids_are_unknown(self):
        raw = ros.serialise(ros.point_cloud(np.ones((3, 3)), {'intensity': np.ones(3)}))
        assert clouds.decode_point_cloud(raw).ids.tolist() == [-1, -1, -1]
        assert 'id' not in clouds.read_fields(raw, 'sensor_msgs/msg/PointCloud').names

    @pytest.mark.parametrize('bad_id', [0.5, -2.0, np.nan, np.inf, 2.0**24])
    def test_a_point_whose_id_float32_cannot_hold_is_marked_and_the_others_are_taken(self, bad_id):
        raw = ros.serialise(ros.point_cloud(np.ones((2, 3)), {'id': np.array([1, bad_id])}))
        assert clouds.decode_point_cloud(raw).ids.tolist() == [1, IMPOSSIBLE_ID]
        raw = ros.serialise(ros.point_cloud(np.ones((2, 3)), {'id': np.array([bad_id, bad_id])}))
        with pytest.raises(MessageError, match='not a whole number'):
            clouds.decode_point_cloud(raw)

    def test_id_channel_of_another_length_is_refused(self):
        raw = ros.serialise(ros.point_cloud(np.ones((2, 3)), {'id': np.ones(3)}))
        with pytest.raises(MessageError, match='3 ids for 2 points'):
            clouds.decode_point_cloud(raw)

    @given(FRAMES, st.integers(0, 5))
    def test_encoder_writes_what_the_ros_serialiser_writes(self, frame_id, count):
        ids, points = np.arange(count), np.arange(3.0 * count).reshape(-1, 3)
        expected = ros.serialise(ros.point_cloud(points, {'id': ids}, frame_id))
        assert encode_point_cloud(ros.STAMP_NS, frame_id, ids, points) == expected

    def test_encoder_refuses_ids_beyond_float32(self):
        with pytest.raises(MessageError, match='16777215'):
            encode_point_cloud(0, '', np.array([2**24]), np.zeros((1, 3)))


class TestPointCloud2:
    """PointCloud2: any layout of the fields that matter, and nothing else."""

    @given(
        st.permutations(['x', 'y', 'z', 'id', 'intensity']),
        st.sampled_from(['f4', 'f8']),
        st.sampled_from(['u1', 'i2', 'u4', 'i4', 'f4']),
        st.integers(0, 5),
        st.tuples(st.integers(1, 3), st.integers(1, 4)),
        st.sampled_from('<>'),
        FRAMES,
        ENDIANNESS,
    )
    def test_any_layout(
        self, names, number, id_type, gap, shape, data_order, frame_id, little_endian
    ):
        formats = [data_order + (id_type if name == 'id' else number) for name in names]
        offsets = np.cumsum([gap] + [np.dtype(f).itemsize + gap for f in formats]).tolist()
        dtype = np.dtype(
            {
                'names': names,
                'formats': formats,
                'offsets': offsets[:-1],
                'itemsize': offsets[-1],
            }
        )
        cloud = records(dtype, shape)
        raw = ros.serialise(ros.point_cloud2(cloud, frame_id, row_padding=gap), little_endian)
        message = clouds.decode_point_cloud2(raw, 42)
        assert (message.sensor_frame, message.stamp_ns) == (frame_id, ros.STAMP_NS)
        np.testing.assert_array_equal(message.ids, 7 + np.arange(cloud.size))
        np.testing.assert_array_equal(message.points, points_of(cloud))
        assert 'id' in clouds.read_fields(raw, 'sensor_msgs/msg/PointCloud2').names

    @given(st.integers(0, 5), st.booleans(), st.booleans())
    def test_layout_round_trip(self, count, with_covariances, with_velocities):
        random = np.random.default_rng(count)
        roots = random.normal(size=(count, 3, 3)).astype(np.float32)
        # Symmetric sums of float32 numbers, rounded once, survive the trip exactly.
        covariances = (roots + roots.swapaxes(1, 2)).astype(np.float32).astype(float)
        points, velocities = random.normal(size=(2, count, 3)).astype(np.float32).astype(float)
        ids = np.arange(-1, count - 1)
        cloud = ros.OUTGOING.point_cloud2(
            ros.STAMP_NS,
            'map',
            ids,
            points,
            covariances if with_covariances else None,
            velocities if with_velocities else None,
        )
        raw = ros.serialise(cloud)
        event = clouds.decode_point_cloud2(raw)
        np.testing.assert_array_equal(event.ids, ids)
        np.testing.assert_array_equal(event.points, points)
        if with_covariances and count:
            np.testing.assert_array_equal(event.covariances, covariances)
        else:
            assert event.covariances is None
        if with_velocities and count:
            np.testing.assert_array_equal(event.velocities, velocities)
        else:
            assert event.velocities is None

    def test_layout_starts_with_what_viewers_display(self):
        cloud = ros.OUTGOING.point_cloud2(0, 'map', np.array([3]), np.ones((1, 3)))
        assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
            ('x', 0, 7),
            ('y', 4, 7),
            ('z', 8, 7),
            ('id', 12, 6),
        ]
        assert cloud.point_step == 16

    @pytest.mark.parametrize('bad_id', [-2, 2**32 - 1])
    def test_layout_refuses_ids_beyond_uint32(self, bad_id):
        with pytest.raises(MessageError, match='landmark ids'):
            ros.OUTGOING.point_cloud2(0, 'map', np.array([bad_id]), np.zeros((1, 3)))

    def test_empty_cloud_needs_no_fields(self):
        raw = ros.serialise(ros.point_cloud2(np.zeros((0, 0), np.dtype([('q', 'f4')]))))
        event = clouds.decode_point_cloud2(raw)
        assert event.points.shape == (0, 3)
        assert event.ids.shape == (0,)

    def test_without_ids_all_are_unknown(self):
        cloud = records(np.dtype([(name, '<f4') for name in 'xyz']))
        event = clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(cloud)))
        assert event.ids.tolist() == [-1, -1, -1]

    def test_zero_covariances_are_unknown(self):
        names = ['x', 'y', 'z', *clouds.COVARIANCE_NAMES]
        cloud = np.zeros((1, 2), [(name, '<f4') for name in names])
        event = clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(cloud)))
        assert event.covariances is None

    @pytest.mark.parametrize('id_type', ['<u4', '<f4'])
    def test_any_bits_may_be_in_a_float(self, id_type):
        signalling_nan = np.uint32(0x7F800001).view(np.float32)
        points = np.full((1, 2), 0, [*POINT_TYPE.descr[:3], ('id', id_type)])
        points['y'] = signalling_nan
        event = clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(points)))
        assert event.points.shape == (0, 3)
        cloud = ros.point_cloud(np.full((1, 3), signalling_nan), {})
        event = clouds.decode_point_cloud(ros.serialise(cloud))
        assert event.points.shape == (0, 3)

    @pytest.mark.parametrize('is_dense', [True, False])
    @pytest.mark.parametrize('unmeasured', [np.nan, np.inf, -np.inf])
    def test_unmeasured_points_are_left_out_and_the_others_used(self, is_dense, unmeasured):
        names = [*clouds.COVARIANCE_NAMES, *clouds.VELOCITY_NAMES]
        cloud = records(np.dtype([*POINT_TYPE.descr, *((name, '<f4') for name in names)]))
        whole = ros.serialise(ros.point_cloud2(cloud))
        cloud['y'][0, 1] = unmeasured
        sparse = ros.serialise(ros.point_cloud2(cloud, is_dense=is_dense))
        event = clouds.decode_point_cloud2(sparse)
        expected = clouds.decode_point_cloud2(whole).select(np.array([True, False, True]))
        assert event.ids.tolist() == [7, 9]
        for name in ('points', 'covariances', 'velocities'):
            np.testing.assert_array_equal(getattr(event, name), getattr(expected, name))

    @pytest.mark.parametrize(
        ('id_type', 'junk'), [('<f4', np.nan), ('<f8', -9999), ('<i4', -9999), ('<i4', -1)]
    )
    def test_unmeasured_points_may_have_any_id(self, id_type, junk):
        dtype = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', id_type)])
        cloud = records(dtype, (2, 3))
        cloud['x'][:, 1], cloud['id'][:, 1] = np.nan, junk
        raw = ros.serialise(ros.point_cloud2(cloud, row_padding=5))
        event = clouds.decode_point_cloud2(raw)
        assert event.ids.tolist() == [7, 9, 10, 12]
        np.testing.assert_array_equal(event.points, points_of(cloud)[[0, 2, 3, 5]])

    @pytest.mark.parametrize('junk', [np.nan, -9999])
    def test_unmeasured_points_of_a_point_cloud_may_have_any_id(self, junk):
        points = np.array([[1.0, 2.0, 3.0], [np.inf] * 3])
        raw = ros.serialise(ros.point_cloud(points, {'id': np.array([7, junk])}))
        assert clouds.decode_point_cloud(raw).ids.tolist() == [7]

    def test_unmeasured_points_of_a_point_cloud_are_left_out(self):
        points = np.array([[1.0, 2.0, 3.0], [np.nan] * 3, [4.0, 5.0, 6.0]])
        raw = ros.serialise(ros.point_cloud(points, {'id': np.array([7, 8, 9])}))
        event = clouds.decode_point_cloud(raw)
        assert event.ids.tolist() == [7, 9]
        np.testing.assert_array_equal(event.points, points[[0, 2]])

    @pytest.mark.parametrize(
        ('fields', 'reason'),
        [
            ([('y', 'f4'), ('z', 'f4')], 'missing field x'),
            ([('x', 'f4'), ('y', 'f4'), ('z', 'i4')], 'field z is not of type FLOAT32'),
            ([('x', 'f4'), ('y', 'f4'), ('z', 'f4'), ('cov_xx', 'f4')], 'missing field cov_xy'),
            ([('x', 'f4'), ('y', 'f4'), ('z', 'f4'), ('vx', 'f4')], 'missing field vy vz'),
        ],
    )
    def test_missing_or_mistyped_field_is_named(self, fields, reason):
        raw = ros.serialise(ros.point_cloud2(records(np.dtype(fields))))
        with pytest.raises(MessageError, match=reason):
            clouds.decode_point_cloud2(raw)

    @pytest.mark.parametrize(
        ('id_type', 'largest'), [('<f4', 2**24 - 1), ('>f8', MAX_ID), ('<f8', MAX_ID)]
    )
    def test_ids_in_a_float_field_are_taken_as_far_as_they_are_exact(self, id_type, largest):
        dtype = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', id_type)])
        cloud = records(dtype.newbyteorder(id_type[0]))
        cloud['id'][0] = [-1, largest - 1, largest]
        event = clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(cloud)))
        assert event.ids.tolist() == [-1, largest - 1, largest]
        cloud['id'][0, 2] = largest + 1
        event = clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(cloud)))
        assert event.ids.tolist() == [-1, largest - 1, IMPOSSIBLE_ID]
        cloud['id'][0] = largest + 1
        reason = f'landmark id {largest + 1} .* whole number from -1 to {largest}$'
        with pytest.raises(MessageError, match=reason):
            clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(cloud)))

    def test_a_point_with_a_negative_id_is_marked_and_clouds_of_them_are_refused(self):
        cloud = records(np.dtype([('x', 'f4'), ('y', 'f4'), ('z', 'f4'), ('id', 'i4')]))
        cloud['id'][0, 2] = -5
        event = clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(cloud)))
        assert (event.ids == IMPOSSIBLE_ID).tolist() == [False, False, True]
        cloud['id'][0] = -5
        with pytest.raises(MessageError, match='negative landmark id -5'):
            clouds.decode_point_cloud2(ros.serialise(ros.point_cloud2(cloud)))

    @pytest.mark.parametrize(
        ('change', 'reason'),
        [
            ({'width': 4}, 'data too short'),
            ({'height': 2, 'row_step': 16}, 'row_step 16 is shorter'),
            ({'height': 2}, 'data too short'),
            ({'point_step': 10}, 'beyond point_step 10'),
            ({'point_step': 2**31}, 'data too short'),
            ({'point_step': 2**32 - 1}, 'data too short'),
            ({'width': 2**32 - 1, 'height': 2**32 - 1}, 'row_step'),
        ],
    )
    def test_sizes_that_do_not_fit_are_refused(self, change, reason):
        cloud = ros.point_cloud2(records(POINT_TYPE))
        for name, value in change.items():
            setattr(cloud, name, value)
        with pytest.raises(MessageError, match=reason):
            clouds.decode_point_cloud2(ros.serialise(cloud))


ROLES = ('velocity', 'angular velocity', 'landmarks', 'pose')
DECODERS = {
    **{(name, role): decode for role in ROLES for name, decode in decoders(role).items()},
    (poses.TRANSFORMS, 'tf'): poses.decode_transforms,
}


MARKERS = [(7, (1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8))]


def example_messages() -> dict[str, bytes]:
    """One message of each type that is decoded."""
    pose = ros.pose((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    uncertain = ros.make('geometry_msgs/msg/PoseWithCovariance', pose, COVARIANCE.ravel())
    twist = ros.make(
        'geometry_msgs/msg/TwistWithCovariance', ros.twist([1.0] * 6), COVARIANCE.ravel()
    )
    transform = ros.transform_stamped(('map', 'base'), (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    header = ros.header('map')
    examples = (
        ros.twist([1.0] * 6),
        ros.twist_stamped([1.0] * 6),
        ros.make('geometry_msgs/msg/TwistWithCovarianceStamped', header, twist),
        ros.odometry([1.0] * 6, COVARIANCE),
        ros.imu([1.0, 2.0, 3.0], np.eye(3)),
        ros.point_cloud(np.ones((3, 3)), {'id': np.arange(3)}),
        ros.point_cloud2(records(POINT_TYPE)),
        detector.pose_array([(1.0, 2.0, 3.0)], 'camera'),
        detector.detections([detector.detection('7', 'post_3', np.eye(3))], 'camera'),
        detector.apriltags([('tag36h11', 5)], 'camera'),
        detector.boxes([('lamp_5', (400.0, 200.0))], 'camera'),
        detector.aruco_markers(MARKERS, 'camera'),
        detector.aruco_markers(MARKERS, 'camera', package='aruco_interfaces'),
        detector.aruco_detection(MARKERS, 'camera', boards=['dock']),
        detector.isaac_apriltags(MARKERS, 'camera'),
        detector.landmark_list([('dock', *MARKERS[0][1:])], 'camera', weights=(10.0, 5.0)),
        detector.range_bearing([(7, 2.0, 0.1, 0.2)], 'mast', deviations=(0.1, 0.01, 0.01)),
        *detector.ranges_of_packages(),
        detector.one_range('anchor_7', 2.0),
        ros.make('geometry_msgs/msg/PoseStamped', header, pose),
        ros.make('geometry_msgs/msg/PoseWithCovarianceStamped', header, uncertain),
        transform,
        ros.make('tf2_msgs/msg/TFMessage', [transform]),
    )
    examples = {message.__msgtype__: ros.serialise(message) for message in examples}
    examples['sensor_msgs/msg/Range'] = examples['sensor_msgs/msg/Range'][:-4]  # until Iron
    return examples


EXAMPLES = example_messages()
all_decoders = pytest.mark.parametrize('key', DECODERS, ids=lambda key: f'{key[0]}-{key[1]}')


class TestMalformed:
    """Whatever the bytes, a decoder returns a message or raises MessageError."""

    def test_there_is_an_example_of_each_type(self):
        assert {name for name, _ in DECODERS} == set(EXAMPLES)

    @all_decoders
    def test_every_truncation_is_refused_and_what_is_longer_is_of_another_type(self, key):
        raw = EXAMPLES[key[0]]
        DECODERS[key](raw, 0)
        for size in range(len(raw)):
            with pytest.raises(MessageError):
                DECODERS[key](raw[:size], 0)
        with pytest.raises(MessageError, match='another type'):
            DECODERS[key](raw + bytes(64), 0)

    @all_decoders
    def test_a_thousand_mutations_never_raise_anything_else(self, key):
        """Lengths, numbers and texts that no publisher sends, in any place."""
        random = np.random.default_rng(list(key[0].encode()))
        words = [0, 1, 0x7F, 0xFF, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 0x7F800000, 0x7FC00000]
        whole = np.frombuffer(EXAMPLES[key[0]], np.uint8)
        for _ in range(1000):
            raw = whole.copy()
            for _ in range(random.integers(1, 5)):
                at = random.integers(len(raw) - 4)
                word = int(random.choice(words)) if random.random() < 0.7 else random.bytes(4)
                raw[at : at + 4] = np.frombuffer(
                    word if isinstance(word, bytes) else word.to_bytes(4, 'little'), np.uint8
                )
            try:
                DECODERS[key](raw.tobytes(), 0)
            except MessageError as error:
                assert str(error)

    def test_other_encapsulations_are_refused(self):
        raw = b'\0\x03' + EXAMPLES['geometry_msgs/msg/Twist'][2:]
        with pytest.raises(MessageError, match='not plain CDR'):
            poses.decode_twist(raw, 0)

    def test_huge_sequence_length_allocates_nothing(self):
        raw = bytearray(ros.serialise(ros.point_cloud(np.zeros((0, 3)), {}, '')))
        raw[-8:-4] = struct.pack('<I', 2**32 - 1)
        with pytest.raises(MessageError, match='too short'):
            clouds.decode_point_cloud(bytes(raw))


def outgoing_messages(make):
    """Return one message of each kind that is published or recorded."""
    stamp, pose, velocity = ros.STAMP_NS, np.eye(4), np.array([0.0, 0.0, -0.5, 1.5, 0.0, 0.0])
    pose[:3, 3] = [1.0, 2.0, 3.0]
    cloud = np.array([4, -1]), np.arange(6.0).reshape(2, 3)
    covariances, velocities = np.tile(np.diag([1.0, 2.0, 3.0]), (2, 1, 1)), np.ones((2, 3))
    return [
        make.time(stamp),
        make.header(stamp, 'base_link'),
        make.point(pose[:3, 3]),
        make.vector(pose[:3, 3]),
        make.quaternion(pose[:3, :3]),
        make.pose(pose),
        make.pose_stamped(stamp, 'map', pose),
        make.transform_stamped(stamp, 'map', 'base_link', pose),
        make.twist(velocity),
        make.twist_stamped(stamp, 'base_link', velocity),
        make.point_cloud2(stamp, 'map', *cloud),
        make.point_cloud2(stamp, 'map', *cloud, covariances, velocities),
    ]


@pytest.mark.parametrize('covariance', [ANGULAR_FIRST_COVARIANCE, None])
def test_a_covariance_that_is_sent_is_read_again(covariance):
    raw = StateMessages('map', '').pose(ros.STAMP_NS, uncertain_pose(np.eye(4), covariance))
    read = poses.decode_pose_with_covariance_stamped(raw).covariance
    if covariance is None:
        assert read is None
    else:
        np.testing.assert_array_equal(read, covariance)


@given(FRAMES, FRAMES)
def test_the_state_is_serialised_as_rosbags_does(map_frame, base_frame):
    turned = so3.exp(np.array([0.1, -0.2, 0.3]))
    pose, velocity = se3.pose(turned, np.array([1.0, 2.0, 3.0])), np.arange(1.0, 7.0)
    position, quaternion = pose[:3, 3].tolist(), so3.to_quaternion(turned).tolist()
    linear_first = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
    sent = COVARIANCE[linear_first]
    messages_of_state = StateMessages(map_frame, base_frame)

    odometry = ros.odometry(velocity, sent, position, quaternion, (map_frame, base_frame))
    made_of = uncertain_pose(pose, COVARIANCE)
    made = messages_of_state.odometry(ros.STAMP_NS, made_of, velocity, COVARIANCE)
    assert made == ros.serialise(odometry)

    uncertain = ros.make(
        'geometry_msgs/msg/PoseWithCovarianceStamped', ros.header(map_frame), odometry.pose
    )
    assert messages_of_state.pose(ros.STAMP_NS, made_of) == ros.serialise(uncertain)

    transform = ros.transform_stamped((map_frame, base_frame), position, quaternion)
    expected = ros.serialise(ros.make('tf2_msgs/msg/TFMessage', [transform]))
    assert encode_transform(ros.STAMP_NS, map_frame, base_frame, pose) == expected


def test_a_message_that_is_made_leaves_the_one_before_as_it_is():
    state = StateMessages('map', 'base_link')
    first = state.pose(1, uncertain_pose(np.eye(4), None))
    kept = bytes(first)
    state.pose(2, uncertain_pose(np.eye(4), COVARIANCE))
    assert first == kept


def test_rclpy_serialises_the_same_bytes():
    """What rosbags' serialiser stands for here is what the middleware really sends."""
    serialization = pytest.importorskip('rclpy.serialization')
    from slam_observer_ros.nodes.ros_node import MESSAGES

    messages_of_rclpy = outgoing_messages(MESSAGES)
    for message, recorded in zip(messages_of_rclpy, outgoing_messages(ros.OUTGOING), strict=True):
        raw = ros.serialise(recorded)
        assert serialization.deserialize_message(raw, type(message)) == message
    published = [serialization.serialize_message(message) for message in messages_of_rclpy]
    decoded = poses.decode_twist_stamped(published[-3])
    assert (decoded.sensor_frame, decoded.stamp_ns) == ('base_link', ros.STAMP_NS)
    assert decoded.body_velocity.tolist() == [0.0, 0.0, -0.5, 1.5, 0.0, 0.0]
    event = clouds.decode_point_cloud2(published[-2])
    assert event.ids.tolist() == [4, -1]
    assert event.points.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]


class TestMarkers:
    """What is drawn of half points."""

    def test_distances_are_circles_and_directions_lines(self):
        points = np.array([[3.0, 4.0, 1.0], [0.0, 2.0, 0.0], [5.0, 5.0, 5.0]])
        update = Update(
            stamp_ns=0,
            pose=np.eye(4),
            ids=np.array([9, 4, 7]),
            residuals=np.array([[0.0, 0.5, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 0.0]]),
            rejected=np.zeros(3, bool),
            lyapunov=0.0,
            moved_ids=np.empty(0, np.int64),
            kinds=np.array([BEARING, RANGE, POINT]),
        )
        drawn = EstimateMessages(ros.OUTGOING, 'map').markers(
            0, np.array([4, 9, 7]), points, None, update, np.array([7, 8])
        )
        by_namespace = {marker.ns: marker for marker in drawn.markers}
        ring = np.array([[p.x, p.y, p.z] for p in by_namespace['ranges'].points])
        radii = np.linalg.norm(ring[:, :2] - points[0, :2], axis=1)
        np.testing.assert_allclose(radii, np.hypot(3.6, 4.8))
        assert set(ring[:, 2]) == {0.0}, 'as high as the robot'
        (start, end) = by_namespace['bearings'].points
        assert (start.x, start.y, start.z, end.x, end.y, end.z) == (0, 0, 0, 0, 2.5, 0)
        whole = EstimateMessages(ros.OUTGOING, 'map').markers(
            0, np.array([4, 9, 7]), points, None, replace(update, kinds=None), np.array([8])
        )
        assert {marker.ns for marker in whole.markers}.isdisjoint({'ranges', 'bearings'})
        # Landmarks that another map which fits has elsewhere have another colour.
        (doubted,), others = by_namespace['in doubt'].points, by_namespace['landmarks'].points
        assert (doubted.x, doubted.y, doubted.z, len(others)) == (5.0, 5.0, 5.0, 2)
        assert by_namespace['in doubt'].color != by_namespace['landmarks'].color
        assert 'in doubt' not in {marker.ns for marker in whole.markers}
