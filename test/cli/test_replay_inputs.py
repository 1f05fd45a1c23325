"""``slam-observer replay`` makes of a recording what the live node made of its messages."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest
import ros_messages as ros
from tum_files import read_tum

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import TopicNames
from slam_observer_ros.recordings.trajectory import LandmarkTruth, PoseTruth
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.settings.node_settings import InputSettings

MS = 1_000_000
STEP_NS = 50 * MS
STEPS = 80
V = np.array([0.0, 0.0, 0.4, 1.0, 0.0, 0.0])
WRONG_TURN = np.array([0.0, 0.0, 0.1, 1.0, 0.0, 0.0])
LANDMARKS = np.random.default_rng(0).uniform([-4, -4, -1], [8, 8, 2], (12, 3))
IDS = np.arange(12)
PAN_RATE = np.array([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
CAMERA = se3.from_rpy((0.1, 0.0, 0.2, -np.pi / 2, 0.0, -np.pi / 2))
IMU_MOUNT = se3.from_rpy((0.1, 0.2, 0.3, 0.0, np.pi / 2, 0.0))


def true_pose(stamp_ns):
    return se3.exp(V * (stamp_ns - ros.STAMP_NS) / 1e9)


def turret(stamp_ns):
    """The pan head, which turns on the robot."""
    return se3.from_rpy((0.3, 0.0, 0.5, 0.0, 0.0, 0.0)) @ se3.exp(
        PAN_RATE * (stamp_ns - ros.STAMP_NS) / 1e9
    )


def seen_by_base(stamp_ns):
    return se3.transform(se3.inverse(true_pose(stamp_ns)), LANDMARKS)


class Drive:
    """Writes what a robot records on a drive in a circle."""

    def __init__(self, writer):
        self.writer = writer

    def write(self, topic, message, receive_ns):
        self.writer.write(topic, message.__msgtype__, ros.serialise(message), receive_ns)

    def transforms(self, topic, receive_ns, *transforms):
        """Write one message of (parent, child, pose, stamp)."""
        messages = [
            ros.transform_stamped(
                (parent, child), pose[:3, 3], so3.to_quaternion(pose[:3, :3]), stamp_ns
            )
            for parent, child, pose, stamp_ns in transforms
        ]
        self.write(topic, ros.make('tf2_msgs/msg/TFMessage', messages), receive_ns)

    def landmarks(self, stamp_ns, sensor=None, frame_id='base_link'):
        points = seen_by_base(stamp_ns)
        if sensor is not None:
            points = se3.transform(se3.inverse(sensor), points)
        self.writer.write_observation(ObservationEvent(stamp_ns, IDS, points), frame_id=frame_id)


def stamps_ns():
    return range(ros.STAMP_NS, ros.STAMP_NS + STEPS * STEP_NS, STEP_NS)


@pytest.fixture
def panning(tmp_path):
    """A recording whose camera is on a pan head; /tf comes 10 ms after what it places."""
    path = tmp_path / 'panning.mcap'
    with RecordingWriter(path) as writer:
        drive = Drive(writer)
        mount = ('turret', 'camera', CAMERA, ros.STAMP_NS)
        drive.transforms('/tf_static', ros.STAMP_NS, mount)
        for stamp_ns in stamps_ns():
            before_ns, after_ns = stamp_ns - 20 * MS, stamp_ns + 10 * MS
            writer.write_velocity(VelocityEvent(stamp_ns, V))
            drive.landmarks(stamp_ns, turret(stamp_ns) @ CAMERA, 'camera')
            points = se3.transform(se3.inverse(turret(stamp_ns) @ CAMERA), seen_by_base(stamp_ns))
            drive.transforms(
                '/tf',
                after_ns,
                ('base_link', 'turret', turret(before_ns), before_ns),
                ('base_link', 'turret', turret(after_ns), after_ns),
                ('odom', 'base_link', true_pose(stamp_ns), stamp_ns),
                ('world', 'true_robot', true_pose(stamp_ns), stamp_ns),
                *(
                    ('camera', f'tag_{number}', se3.pose(np.eye(3), point), stamp_ns)
                    for number, point in enumerate(points)
                ),
            )
            writer.write_pose(PoseTruth(stamp_ns, true_pose(stamp_ns)))
        writer.write_landmarks(ros.STAMP_NS, LandmarkTruth(IDS, LANDMARKS))
    return path


class TestMovingMounts:
    @pytest.mark.parametrize('topic', [None, '/tf'])
    def test_a_camera_that_turns_on_the_robot_is_placed_by_tf(self, panning, topic):
        with Recording(panning) as recording:
            events = list(recording.events(recording.find_topics(TopicNames(landmarks=topic))))
        observations = [event for event in events if isinstance(event, ObservationEvent)]
        assert [event.stamp_ns for event in observations] == list(stamps_ns())
        for event in observations:
            expected = seen_by_base(event.stamp_ns)[event.ids]
            assert_allclose(event.points, expected, atol=1e-5)  # float32 in the cloud

    @pytest.mark.parametrize('options', [(), ('--landmarks-topic', '/tf')])
    def test_the_estimate_is_then_right(self, slam_observer, panning, options):
        report = slam_observer.succeed('replay', panning, '--json', *options).json
        assert report['dropped'] == {}
        assert report['ate_rmse_m'] < 1e-3
        assert report['configuration_rmse_m'] < 1e-3

    def test_what_no_transform_places_is_dropped_and_reported_once(self, slam_observer, panning):
        ended = slam_observer('replay', panning, '--json', '--set', 'transform_timeout=0')
        assert ended.code == 0
        assert ended.json['dropped'] == {'no_transform': STEPS}
        assert ended.json['events'] == 2 * STEPS
        assert ended.errors.count('Dropped a message, no_transform: ') == 1
        assert 'dropped_message' in [finding['kind'] for finding in ended.json['findings']]
        assert "'camera' and 'base_link' are not connected" in ended.errors

    def test_what_still_waits_at_the_end_is_dropped(self, slam_observer, tmp_path):
        path = tmp_path / 'blind.mcap'
        with RecordingWriter(path) as writer:
            writer.write_velocity(VelocityEvent(ros.STAMP_NS, V))
            Drive(writer).landmarks(ros.STAMP_NS, frame_id='camera')
        ended = slam_observer('replay', path, '--json')
        assert ended.json['dropped'] == {'no_transform': 1}
        assert "'camera' and 'base_link' are not connected" in ended.errors

    def test_landmarks_stated_in_the_map_are_dropped_and_reported_once(
        self, slam_observer, tmp_path
    ):
        path = tmp_path / 'loop.mcap'
        with RecordingWriter(path) as writer:
            drive = Drive(writer)
            for stamp_ns in list(stamps_ns())[:20]:
                writer.write_velocity(VelocityEvent(stamp_ns, V))
                pose = true_pose(stamp_ns)
                drive.transforms('/tf', stamp_ns, ('map', 'base_link', pose, stamp_ns))
                drive.landmarks(stamp_ns, se3.inverse(pose), 'map')
        ended = slam_observer('replay', path, '--json')
        assert ended.json['dropped'] == {'no_transform': 20}
        assert ended.json['landmarks'] == 0
        reason = "landmarks are given in 'map', which is estimated from these very landmarks"
        assert ended.errors.count(reason) == 1

    @pytest.fixture
    def camera_on(self, tmp_path):
        """Writes one observation of a camera that trees of transforms place, each 1 m apart."""

        def write(trees, topics=('/robot1/odom', '/robot1/tags')):
            with RecordingWriter(tmp_path / 'trees.mcap') as writer:
                drive = Drive(writer)
                for x, tree in enumerate(trees, start=1):
                    mount = se3.pose(np.eye(3), np.array([x, 0.0, 0.0]))
                    transform = ('base_link', 'camera', mount, ros.STAMP_NS)
                    drive.transforms(tree, ros.STAMP_NS, transform)
                velocity, landmarks = topics
                writer.write_velocity(VelocityEvent(ros.STAMP_NS, V), topic=velocity)
                event = ObservationEvent(ros.STAMP_NS, np.array([3]), np.zeros((1, 3)))
                writer.write_observation(event, topic=landmarks, frame_id='camera')
            with Recording(tmp_path / 'trees.mcap') as recording:
                selected = recording.find_topics(TopicNames(velocity, landmarks))
                events = list(recording.events(selected))
            return [event.points[0, 0] for event in events if isinstance(event, ObservationEvent)]

        return write

    @pytest.mark.parametrize('name', ['tf_static', 'tf'])
    def test_each_robots_sensors_are_placed_by_its_own_transforms(self, camera_on, name):
        assert camera_on([f'/robot1/{name}', f'/robot2/{name}', f'/{name}']) == [1.0]

    @pytest.mark.parametrize('trees', [['/robot2/tf_static'], ['/tf_static', '/robot2/tf_static']])
    def test_without_transforms_of_their_own_those_of_all_or_the_only_ones_count(
        self, camera_on, trees
    ):
        assert camera_on(trees) == [1.0]

    def test_transforms_of_several_robots_that_are_not_the_sensors_are_not_used(
        self, camera_on, caplog
    ):
        assert camera_on(['/robot2/tf_static', '/robot3/tf_static']) == []
        assert '/robot2/tf_static, /robot3/tf_static' in caplog.text

    def test_a_sensor_that_is_not_on_tf_is_placed_by_parameter(self, slam_observer, tmp_path):
        path = tmp_path / 'placed.mcap'
        with RecordingWriter(path) as writer:
            for stamp_ns in stamps_ns():
                writer.write_velocity(VelocityEvent(stamp_ns, V))
                Drive(writer).landmarks(stamp_ns, CAMERA, 'camera')
                writer.write_pose(PoseTruth(stamp_ns, true_pose(stamp_ns)))
        pose = [0.1, 0.0, 0.2, -np.pi / 2, 0.0, -np.pi / 2]
        report = slam_observer.succeed(
            'replay', path, '--json', '--set', f'sensor_pose={pose}'
        ).json
        assert report['ate_rmse_m'] < 1e-3


@pytest.fixture
def wheels_and_gyroscope(tmp_path):
    """Odometry whose poses are right and whose twist turns wrongly, and an Imu on its side."""
    path = tmp_path / 'wheels.mcap'
    with RecordingWriter(path) as writer:
        drive = Drive(writer)
        mount = ('base_link', 'imu', IMU_MOUNT, ros.STAMP_NS)
        drive.transforms('/tf_static', ros.STAMP_NS, mount)
        for stamp_ns in stamps_ns():
            pose = true_pose(stamp_ns)
            odometry = ros.odometry(
                WRONG_TURN, np.zeros((6, 6)), pose[:3, 3], so3.to_quaternion(pose[:3, :3]),
                stamp_ns=stamp_ns,
            )  # fmt: skip
            drive.write('/odom', odometry, stamp_ns)
            turn = IMU_MOUNT[:3, :3].T @ V[:3]
            turned_ns = stamp_ns + 10 * MS
            drive.write('/imu/data', ros.imu(turn, np.zeros((3, 3)), 'imu', turned_ns), turned_ns)
            if stamp_ns == ros.STAMP_NS:
                drive.landmarks(stamp_ns)
            writer.write_pose(PoseTruth(stamp_ns, pose))
    return path


class TestVelocities:
    @pytest.mark.parametrize(
        'options',
        [
            ('--velocity-source', 'pose_differences'),
            ('--set', 'velocity_source=pose_differences'),
            ('--imu', '/imu/data'),
            ('--set', 'use_imu=true'),
        ],
    )
    def test_other_sources_than_the_twist(self, slam_observer, wheels_and_gyroscope, options):
        arguments = ('replay', wheels_and_gyroscope, '--json')
        plain = slam_observer(*arguments)
        assert plain.json['dead_reckoning_ate_rmse_m'] > 0.1
        assert 'The twist on /odom does not say the turn of its poses' in plain.errors
        report = slam_observer.succeed(*arguments, *options).json
        assert report['dead_reckoning_ate_rmse_m'] < 0.01
        assert report['dropped'] == {}

    @pytest.mark.parametrize('moves', [True, False])
    def test_odometry_without_velocities_but_with_poses(self, slam_observer, tmp_path, moves):
        path = tmp_path / 'odometry.mcap'
        with RecordingWriter(path) as writer:
            drive = Drive(writer)
            for stamp_ns in stamps_ns():
                position = true_pose(stamp_ns)[:3, 3] if moves else np.zeros(3)
                odometry = ros.odometry(np.zeros(6), np.zeros((6, 6)), position, stamp_ns=stamp_ns)
                drive.write('/odom', odometry, stamp_ns)
                if stamp_ns == ros.STAMP_NS:
                    drive.landmarks(stamp_ns)
        errors = slam_observer('replay', path).errors
        assert errors.count('set velocity_source: pose_differences') == moves
        again = slam_observer('replay', path, '--velocity-source', 'pose_differences')
        assert again.errors == ''

    def test_a_moment_of_motion_is_not_taken_for_none(self, slam_observer, tmp_path):
        path = tmp_path / 'moment.mcap'
        with RecordingWriter(path) as writer:
            Drive(writer).landmarks(ros.STAMP_NS)
            for stamp_ns in (ros.STAMP_NS, ros.STAMP_NS + 20 * MS):
                position = true_pose(stamp_ns)[:3, 3]
                odometry = ros.odometry(V, np.zeros((6, 6)), position, stamp_ns=stamp_ns)
                Drive(writer).write('/odom', odometry, stamp_ns)
        assert 'All velocities' not in slam_observer('replay', path).errors

    def test_an_odometry_that_is_reset_on_the_way(self, slam_observer, tmp_path):
        path = tmp_path / 'reset.mcap'
        reset_ns = ros.STAMP_NS + STEPS // 2 * STEP_NS
        with RecordingWriter(path) as writer:
            drive = Drive(writer)
            drive.landmarks(ros.STAMP_NS)
            for stamp_ns in stamps_ns():
                pose = true_pose(stamp_ns)
                if stamp_ns >= reset_ns:
                    pose = se3.inverse(true_pose(reset_ns)) @ pose
                message = ros.odometry(
                    np.zeros(6), np.zeros((6, 6)), 2.0 * pose[:3, 3],
                    so3.to_quaternion(pose[:3, :3]), stamp_ns=stamp_ns,
                )  # fmt: skip
                drive.write('/odom', message, stamp_ns)
                truth = true_pose(stamp_ns).copy()
                truth[:3, 3] *= 2.0
                writer.write_pose(PoseTruth(stamp_ns, truth))
        options = ('--json', '--velocity-source', 'pose_differences')
        ended = slam_observer('replay', path, *options)
        assert ended.json['dropped'] == {'pose_jump': 1}
        assert ended.errors.count('Dropped a message, pose_jump: ') == 1
        assert ended.json['dead_reckoning_ate_rmse_m'] < 0.01

    def test_an_imu_with_the_stamps_of_the_odometry_turns_it_at_once(
        self, slam_observer, tmp_path
    ):
        path = tmp_path / 'synchronous.mcap'
        pose = np.eye(4)
        with RecordingWriter(path) as writer:
            drive = Drive(writer)
            drive.landmarks(ros.STAMP_NS)
            for step, stamp_ns in enumerate(stamps_ns()):
                turned = V * (1, 1, 4.0 * (-1) ** (step // 2), 1, 1, 1)
                drive.write(
                    '/odom', ros.odometry(V, np.zeros((6, 6)), stamp_ns=stamp_ns), stamp_ns
                )
                imu = ros.imu(turned[:3], np.zeros((3, 3)), 'base_link', stamp_ns)
                drive.write('/imu', imu, stamp_ns + 5 * MS)
                writer.write_pose(PoseTruth(stamp_ns, pose))
                pose = pose @ se3.exp(turned * STEP_NS / 1e9)
        report = slam_observer.succeed('replay', path, '--json', '--imu', '/imu').json
        assert report['dropped'] == {}
        assert report['dead_reckoning_ate_rmse_m'] < 1e-3

    def test_the_nodes_file_says_it_too(self, slam_observer, wheels_and_gyroscope, tmp_path):
        config = tmp_path / 'robot.yaml'
        config.write_text('/**: {ros__parameters: {use_imu: true}}')
        output = slam_observer.succeed('replay', wheels_and_gyroscope, '--config', config).output
        assert 'Imu topic' in output
        config.write_text('/**: {ros__parameters: {velocity_source: pose_differences}}')
        arguments = ('replay', wheels_and_gyroscope, '--config', config, '--json')
        assert slam_observer.succeed(*arguments).json['dead_reckoning_ate_rmse_m'] < 0.01
        wins = slam_observer(*arguments, '--velocity-source', 'twist').json
        assert wins['dead_reckoning_ate_rmse_m'] > 0.1

    def test_poses_are_asked_of_odometry_only(self, slam_observer, panning):
        error = slam_observer.fail('replay', panning, '--velocity-source', 'pose_differences')
        assert 'no odometry topic: none of type nav_msgs/msg/Odometry' in error
        error = slam_observer.fail(
            'replay', panning, '--velocity-source', 'pose_differences',
            '--velocity-topic', '/twist',
        )  # fmt: skip
        assert 'can not be the odometry topic' in error

    @pytest.mark.parametrize(
        ('frame_id', 'measures', 'reason'),
        [('imu', True, 'no_transform'), ('base_link', False, 'malformed')],
    )
    def test_an_imu_of_which_nothing_can_be_used(
        self, slam_observer, tmp_path, frame_id, measures, reason
    ):
        path = tmp_path / 'imu.mcap'
        unknown = -np.eye(3)  # so an Imu says that it does not measure this
        with RecordingWriter(path) as writer:
            drive = Drive(writer)
            drive.landmarks(ros.STAMP_NS)
            for stamp_ns in stamps_ns():
                writer.write_velocity(VelocityEvent(stamp_ns, V))
                imu = ros.imu(V[:3], np.zeros((3, 3)) if measures else unknown, frame_id, stamp_ns)
                drive.write('/imu', imu, stamp_ns)
        ended = slam_observer('replay', path, '--json', '--imu', '/imu')
        warning = f'No angular velocity of /imu was used (dropped: {STEPS} {reason})'
        assert ended.errors.count(warning) == 1
        assert 'the one of /twist was taken' in ended.errors

    def test_an_imu_that_is_not_there(self, slam_observer, panning, wheels_and_gyroscope):
        error = slam_observer.fail('replay', panning, '--set', 'use_imu=true')
        assert 'no Imu topic' in error
        error = slam_observer.fail('replay', wheels_and_gyroscope, '--imu', '/odom')
        assert 'can not be the Imu topic' in error

    def test_misspelt_source(self, slam_observer, panning):
        error = slam_observer.fail('replay', panning, '--set', 'velocity_source=wheels')
        assert "'velocity_source' takes one of twist, pose_differences" in error


class TestZeroStamps:
    """What publishers leave unstamped has its receive time, as in the live node."""

    @pytest.mark.parametrize('options', [(), ('--imu', '/imu/data')])
    @pytest.mark.parametrize('source', ['twist', 'pose_differences'])
    def test_a_drive_without_stamps_replays_as_one_with(
        self, slam_observer, tmp_path, source, options
    ):
        reports = {}
        for is_stamped in (True, False):
            path = tmp_path / f'{is_stamped}.mcap'
            with RecordingWriter(path) as writer:
                for received_ns in stamps_ns():
                    self.write(Drive(writer), received_ns, received_ns if is_stamped else 0)
            ended = slam_observer('replay', path, '--json', '--velocity-source', source, *options)
            reports[is_stamped] = ended.json
            for key in ('seconds', 'recording', 'recording_sha256', 'warnings', 'findings'):
                del reports[is_stamped][key]
        assert reports[True]['ate_rmse_m'] < 1e-3
        assert reports[False] == reports[True]
        assert ended.errors.count('slam-observer: warning: ') == 1
        assert 'Stamps are zero on /odom, /landmarks' in ended.errors.replace('/imu/data, ', '')

    def test_where_time_begins_at_zero_zero_is_a_stamp(self, slam_observer, tmp_path):
        path = tmp_path / 'simulated.mcap'
        with RecordingWriter(path) as writer:
            for stamp_ns in range(0, STEPS * STEP_NS, STEP_NS):
                self.write(Drive(writer), stamp_ns, stamp_ns)
        assert slam_observer.succeed('replay', path, '--json').json['dropped'] == {}

    @pytest.mark.parametrize(('second_ns', 'is_stamp'), [(STEP_NS, True), (0, False)])
    def test_a_simulated_clock_that_begins_at_zero_and_is_recorded_by_another(
        self, slam_observer, tmp_path, second_ns, is_stamp
    ):
        path = tmp_path / 'simulated.mcap'
        with RecordingWriter(path) as writer:
            for number, received_ns in enumerate(stamps_ns()):
                self.write(Drive(writer), received_ns, number * second_ns)
        ended = slam_observer('replay', path, '--json')
        assert ended.json['dropped'] == {}
        assert ('Stamps are zero' in ended.errors) == (not is_stamp)
        assert ended.json['ate_rmse_m'] < 1e-3

    def write(self, drive, received_ns, stamp_ns):
        pose = true_pose(received_ns)
        odometry = ros.odometry(
            V, np.zeros((6, 6)), pose[:3, 3], so3.to_quaternion(pose[:3, :3]), stamp_ns=stamp_ns
        )
        drive.write('/odom', odometry, received_ns)
        drive.write('/ground_truth/pose', odometry, received_ns)
        imu = ros.imu(V[:3], np.zeros((3, 3)), 'base_link', stamp_ns)
        drive.write('/imu/data', imu, received_ns)
        seen = ObservationEvent(stamp_ns, IDS, seen_by_base(received_ns))
        drive.writer.write_observation(seen, receive_stamp_ns=received_ns)


class TestTiming:
    """What falls silent, and what has another clock, is reported."""

    IMU = ('--imu', '/imu/data')

    @pytest.fixture
    def warnings_of(self, slam_observer, tmp_path):
        """Replays a drive whose topics end or are stamped as said; returns the warnings."""

        def replay(*options, ends=(), ahead_s=(), duration_s=12, slow_down=1.0):
            path = tmp_path / 'timing.mcap'
            with RecordingWriter(path) as writer:
                for number in range(duration_s * 20):
                    stamp_ns = ros.STAMP_NS + number * STEP_NS
                    for topic in ('/odom', '/imu/data', '/tags'):
                        if number * 0.05 < dict(ends).get(topic, duration_s):
                            later_ns = int(dict(ahead_s).get(topic, 0.0) * 1e9)
                            received_ns = ros.STAMP_NS + int(number * STEP_NS * slow_down)
                            self.write(Drive(writer), topic, stamp_ns, later_ns, received_ns)
            return slam_observer('replay', path, '--json', *options).errors

        return replay

    def write(self, drive, topic, stamp_ns, later_ns, received_ns):
        if topic == '/tags':
            event = ObservationEvent(stamp_ns + later_ns, IDS, seen_by_base(stamp_ns))
            drive.writer.write_observation(event, topic, receive_stamp_ns=received_ns)
            return
        message = ros.imu(V[:3], np.zeros((3, 3)), 'base_link', stamp_ns + later_ns)
        if topic == '/odom':
            message = ros.odometry(V, np.zeros((6, 6)), stamp_ns=stamp_ns + later_ns)
        drive.write(topic, message, received_ns)

    def test_a_drive_without_fault_is_replayed_without_a_word(self, warnings_of):
        assert warnings_of(*self.IMU) == ''

    def test_velocities_that_end_early(self, warnings_of):
        warnings = warnings_of(ends=[('/odom', 6.0)])
        assert 'No velocity on /odom for 5.0 s of 12.0 s (velocity_timeout)' in warnings
        assert warnings.count('warning') == 1

    def test_velocities_that_hold_until_the_end_are_not_missed(self, warnings_of):
        options = ('--set', 'velocity_timeout=10.0')
        assert warnings_of(*options, ends=[('/odom', 6.0)]) == ''

    def test_angular_velocities_that_end_early(self, warnings_of):
        warnings = warnings_of(*self.IMU, ends=[('/imu/data', 6.0)])
        assert 'No angular velocity on /imu/data for 5.0 s of 12.0 s' in warnings
        assert 'the one of /odom was taken' in warnings

    @pytest.mark.parametrize(('end_s', 'is_reported'), [(6.0, True), (9.0, False)])
    def test_landmarks_that_come_no_more_for_the_last_third(self, warnings_of, end_s, is_reported):
        warnings = warnings_of(ends=[('/tags', end_s)])
        assert ('No landmarks on /tags for the last 6.0 s of 12.0 s' in warnings) == is_reported

    @pytest.mark.parametrize(
        ('topic', 'ahead_s', 'expected'),
        [
            ('/tags', 2.0, 'Stamps of /tags are 2.0 s ahead of the stamps of /odom'),
            ('/tags', -2.0, 'Stamps of /tags are 2.0 s behind the stamps of /odom'),
            ('/tags', 3600.0, 'Stamps of /tags are 3600.0 s ahead of the stamps of /odom'),
            ('/tags', 0.4, 'Stamps of /tags are 0.4 s ahead of the stamps of /odom'),
            ('/imu/data', -2.0, 'Stamps of /imu/data are 2.0 s behind the stamps of /odom'),
        ],
    )
    def test_another_clock(self, warnings_of, topic, ahead_s, expected):
        warnings = warnings_of(*self.IMU, ahead_s=[(topic, ahead_s)])
        assert warnings.count('Stamps of') == 1
        assert expected in warnings
        assert 'correct_clock_offset' in warnings

    def test_velocities_of_the_future(self, warnings_of):
        warnings = warnings_of(ahead_s=[('/odom', 0.4), ('/tags', 0.4)])
        assert "Stamps of /odom are 0.4 s ahead of the recorder's clock" in warnings
        assert warnings.count('Stamps of') == 1

    def test_one_clock_that_is_slower_than_the_recorders_is_no_other(self, warnings_of):
        assert 'Stamps of' not in warnings_of(ends=[('/odom', 4.0)], slow_down=3.0)


@pytest.mark.parametrize('has_pose', [True, False])
def test_truth_of_a_type_that_is_not_read_is_reported(slam_observer, tmp_path, has_pose):
    path = tmp_path / 'path.mcap'
    with RecordingWriter(path) as writer:
        for stamp_ns in stamps_ns():
            writer.write_velocity(VelocityEvent(stamp_ns, V))
            Drive(writer).landmarks(stamp_ns)
            if has_pose:
                writer.write_pose(PoseTruth(stamp_ns, true_pose(stamp_ns)))
        true_path = ros.make('nav_msgs/msg/Path', ros.header('world'), [])
        Drive(writer).write('/ground_truth/path', true_path, ros.STAMP_NS)
    errors = slam_observer('replay', path).errors
    if has_pose:
        assert errors == ''
    else:
        assert errors.count('\n') == 1
        assert 'not of a type that true poses are read of (geometry_msgs/msg/Pose' in errors
        assert '/ground_truth/path (nav_msgs/msg/Path, 1 messages)' in errors


@pytest.mark.parametrize('is_placed', [True, False])
def test_true_poses_of_another_frame_are_moved_to_the_base(slam_observer, tmp_path, is_placed):
    path, marker = tmp_path / 'run.mcap', se3.from_rpy((0.5, 0.2, 0.3, 0.0, 0.0, 2.0))
    with RecordingWriter(path) as writer:
        drive = Drive(writer)
        if is_placed:
            drive.transforms('/tf_static', ros.STAMP_NS, ('base_link', 'marker', marker, 0))
        for stamp_ns in stamps_ns():
            writer.write_velocity(VelocityEvent(stamp_ns, V))
            drive.landmarks(stamp_ns)
            seen = true_pose(stamp_ns) @ marker
            turn = so3.to_quaternion(seen[:3, :3])
            frames = ('world', 'marker')
            odometry = ros.odometry(V, np.eye(6), seen[:3, 3], turn, frames, stamp_ns)
            drive.write('/ground_truth/odom', odometry, stamp_ns)
    done = slam_observer('replay', path, '--json')
    warning = "The true poses are of 'marker', and the estimated ones of 'base_link'"
    assert (warning in done.errors) != is_placed
    assert (done.json['ate_rmse_m'] < 1e-3) == is_placed
    # As a TUM file they are the same.
    tum = tmp_path / 'truth.tum'
    written = slam_observer('convert', 'tum', path, tum, '--base-frame', 'base_link')
    assert (warning in written.errors) != is_placed
    poses = np.array([true_pose(stamp_ns) for stamp_ns in stamps_ns()])
    assert_allclose(read_tum(tum).poses, poses if is_placed else poses @ marker, atol=1e-9)
    slam_observer.succeed('convert', 'tum', path, tum, '--force')
    assert_allclose(read_tum(tum).poses, poses @ marker, atol=1e-9)


def test_the_base_frame_of_the_nodes_file_counts(slam_observer, tmp_path):
    path, config = tmp_path / 'run.mcap', tmp_path / 'robot.yaml'
    base_in_wheels = se3.from_rpy((0.5, 0.0, 0.0, 0.0, 0.0, 0.0))
    with RecordingWriter(path) as writer:
        mount = ('wheels', 'base_link', base_in_wheels, ros.STAMP_NS)
        Drive(writer).transforms('/tf_static', ros.STAMP_NS, mount)
        for stamp_ns in stamps_ns():
            writer.write_velocity(VelocityEvent(stamp_ns, V), frame_id='wheels')
            Drive(writer).landmarks(stamp_ns, base_in_wheels)
    config.write_text('/**: {ros__parameters: {base_frame: base_link}}')
    for arguments, start in (((), 0.0), (('--config', config), 0.5)):
        poses = tmp_path / f'{start}.tum'
        slam_observer.succeed('replay', path, '--tum', poses, *arguments)
        start_in_wheels = se3.pose(np.eye(3), np.array([start, 0.0, 0.0]))
        trajectory = read_tum(poses)
        expected = se3.inverse(start_in_wheels) @ true_pose(trajectory.stamps_ns[-1])
        assert_allclose(trajectory.poses[-1], expected @ start_in_wheels, atol=1e-3)


@pytest.mark.parametrize(('base', 'is_right'), [('base_link', True), ('chassis', False)])
def test_velocities_without_a_frame_are_those_of_base_link(
    slam_observer, tmp_path, base, is_right
):
    path, poses = tmp_path / 'run.mcap', tmp_path / 'run.tum'
    with RecordingWriter(path) as writer:
        drive = Drive(writer)
        drive.transforms('/tf_static', ros.STAMP_NS, (base, 'camera', CAMERA, ros.STAMP_NS))
        for stamp_ns in stamps_ns():
            drive.write('/cmd_vel', ros.twist(V.tolist()), stamp_ns)
            drive.landmarks(stamp_ns, CAMERA, 'camera')
    done = slam_observer('replay', path, '--tum', poses)
    assert ("'camera', the landmarks' frame, is taken for the robot" in done.errors) != is_right
    trajectory = read_tum(poses)
    position = true_pose(trajectory.stamps_ns[-1])[:3, 3]
    assert (np.linalg.norm(trajectory.positions[-1] - position) < 0.01) == is_right


@pytest.mark.parametrize('frame_id', ['', 'base_link'])
def test_a_sensor_frame_may_be_the_base_frame_that_no_message_names(
    slam_observer, tmp_path, frame_id
):
    path = tmp_path / 'run.mcap'
    with RecordingWriter(path) as writer:
        drive = Drive(writer)
        for stamp_ns in stamps_ns():
            drive.write('/cmd_vel', ros.twist(V.tolist()), stamp_ns)
            drive.landmarks(stamp_ns, frame_id=frame_id)
    report = slam_observer('replay', path, '--set', 'sensor_frame=base_link', '--json').json
    assert not report['dropped']
    assert report['landmarks'] > 0


def test_velocities_of_the_odometrys_own_frame_do_not_make_it_the_base(tmp_path):
    path = tmp_path / 'odom.mcap'
    with RecordingWriter(path) as writer:
        writer.write_velocity(VelocityEvent(ros.STAMP_NS, V), frame_id='odom')
        Drive(writer).landmarks(ros.STAMP_NS)
    with Recording(path) as recording:
        inputs = InputSettings(transform_timeout=0.0)
        events = list(recording.events(recording.find_topics(), inputs))
    assert [type(event) for event in events] == [VelocityEvent, ObservationEvent]
    assert_allclose(events[0].body_velocity, V)
