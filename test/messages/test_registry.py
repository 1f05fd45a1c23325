"""A message type is one file: node, replay, doctor, parameters and documents follow."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import re
import struct

import numpy as np
from numpy.testing import assert_array_equal
import pytest
import recordings
import ros_messages as ros

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.events import ObservationEvent, VelocityBlock, VelocityEvent
from slam_observer_ros.messages.cdr import CdrReader, encode_string
from slam_observer_ros.messages.poses import decode_twist_stamped
from slam_observer_ros.messages.registry import decoders, reads
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.settings import node_settings as input_settings
from slam_observer_ros.settings.node_settings import InputSettings, ObserverNodeSettings
from slam_observer_ros.settings.parameter_table import table

CONTRIBUTING = Path(__file__).resolve().parents[2] / 'CONTRIBUTING.md'
BEACONS = 'beacon_msgs/msg/BeaconArray'
ACCEL = 'geometry_msgs/msg/AccelStamped'


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    """What a test registers is gone after it."""
    decoders('landmarks')
    monkeypatch.setattr(input_settings, '_REGISTERED', dict(input_settings._REGISTERED))


def choices(settings, name):
    return next(row.choices for row in table(settings) if row.name == name)


@pytest.fixture(name='beacons')
def fixture_beacons(tmp_path):
    """Import the example of CONTRIBUTING as a module of its own."""
    if not CONTRIBUTING.exists():
        pytest.skip('the documents are not installed')
    (code,) = re.findall(r'```python\n(.*?)```', CONTRIBUTING.read_text('utf-8'), re.DOTALL)
    assert code.count('\n') <= 25
    path = tmp_path / 'beacons.py'
    path.write_text(code, 'utf-8')
    spec = spec_from_file_location('slam_observer_ros.messages.beacons', path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)


def beacon_message(stamp_ns, seen):
    """Encode a BeaconArray of ids, ranges and bearings."""
    head = struct.pack('<BBBBiI', 0, 1, 0, 0, *divmod(stamp_ns, 10**9)) + encode_string('mast')
    ids, ranges, bearings = (list(column) for column in zip(*seen, strict=True))
    count = struct.pack('<I', len(ids))
    data = head + count + struct.pack(f'<{len(ids)}I', *ids)
    for values in (ranges, bearings):
        data += count + struct.pack(f'<{len(values)}f', *values)
    return data


def record(path, message_type, messages):
    """Write a run of ``recordings`` with other landmarks; the type is unknown to rosbags."""
    from mcap.writer import Writer

    with path.open('wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        channels = {}
        twists = (
            ('/twist', event.stamp_ns, 'geometry_msgs/msg/TwistStamped',
             ros.serialise(ros.twist_stamped(event.body_velocity, stamp_ns=event.stamp_ns)))
            for event in recordings.events() if isinstance(event, VelocityEvent)
        )  # fmt: skip
        seen = (('/beacons', stamp_ns, message_type, data) for stamp_ns, data in messages)
        for topic, stamp_ns, kind, data in (*twists, *seen):
            if topic not in channels:
                schema = writer.register_schema(kind, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns)
        writer.finish()
    return path


def write_beacons(path):
    messages = []
    for event in recordings.events():
        if isinstance(event, ObservationEvent):
            x, y = event.points[:, :2].T
            seen = zip(event.ids.tolist(), np.hypot(x, y), np.arctan2(y, x), strict=True)
            messages.append((event.stamp_ns, beacon_message(event.stamp_ns, seen)))
    return record(path, BEACONS, messages)


@pytest.mark.usefixtures('beacons')
def test_the_example_of_contributing_is_all_that_a_landmark_type_takes(tmp_path, slam_observer):
    path = write_beacons(tmp_path / 'run.mcap')
    options = ('--set', 'landmarks_type=BeaconArray', '--set', 'sensor_frame=base_link', '--json')
    for chosen in (options, options[2:]):  # named, and found by its type
        ended = slam_observer('replay', path, *chosen)
        assert (ended.code, ended.json['landmarks']) == (0, 3), ended.errors
    with Recording(path) as recording:
        selected = recording.find_topics()
        inputs = InputSettings(sensor_frame='base_link')
        seen = [e for e in recording.events(selected, inputs) if isinstance(e, ObservationEvent)]
    expected = recordings.LANDMARKS.world_points * np.array([1.0, 1.0, 0.0])
    assert_array_equal(seen[0].ids, recordings.LANDMARKS.ids)
    np.testing.assert_allclose(seen[0].points, expected, atol=1e-6)


@pytest.mark.usefixtures('beacons')
def test_parameters_and_help_offer_a_type_and_an_unread_one_is_said_to_be_none(
    tmp_path, slam_observer
):
    helped = slam_observer('replay', '--help').output
    of_landmarks = helped.rpartition('--landmarks-topic TOPIC')[2]
    assert 'BeaconArray' in of_landmarks.partition('--imu TOPIC')[0]
    assert 'BeaconArray' in choices(InputSettings, 'landmarks_type')
    assert 'BeaconArray' in choices(ObserverNodeSettings, 'landmarks_type')
    del input_settings._REGISTERED['landmarks', BEACONS]
    with (
        Recording(write_beacons(tmp_path / 'run.mcap')) as recording,
        pytest.raises(RecordingError, match=rf'no landmark topic: .*{BEACONS}'),
    ):
        recording.find_topics()
    assert 'BeaconArray' not in choices(InputSettings, 'landmarks_type')


def test_two_decoders_of_one_type_are_a_mistake():
    with pytest.raises(ValueError, match=r'is read by .*fiducials already'):
        reads('ros2_aruco_interfaces/msg/ArucoMarkers', role='landmarks')(lambda reader: reader)


def accel_message(stamp_ns, number):
    linear, angular = (
        ros.make('geometry_msgs/msg/Vector3', *vector)
        for vector in ((1.0, 0.0, 0.1 * number), (0.0, 0.0, 0.5))
    )
    measured = ros.make('geometry_msgs/msg/Accel', linear, angular)
    return ros.serialise(ros.make(ACCEL, ros.header('base_link', stamp_ns), measured))


def read_as_one(reader: CdrReader) -> VelocityEvent:
    """Read one message only."""
    stamp_ns, frame_id = reader.header()
    vx, vy, vz, wx, wy, wz = reader.float64(6)
    return VelocityEvent(stamp_ns, np.array([wx, wy, wz, vx, vy, vz]), sensor_frame=frame_id)


def read_the_first_alone(reader: CdrReader) -> VelocityEvent:
    """Read one message only: of many the first, without an error."""
    stamp_ns, frame_id = reader.header()
    values = np.roll(np.atleast_2d(reader.float64(6))[0], 3)
    is_many = np.ndim(stamp_ns)
    velocity = np.tile(values, (len(stamp_ns), 1)) if is_many else values
    return VelocityEvent(stamp_ns, velocity, sensor_frame=frame_id)


@pytest.mark.parametrize(
    ('read', 'in_blocks'),
    [(decode_twist_stamped._read, True), (read_as_one, False), (read_the_first_alone, False)],
)
def test_a_velocity_type_takes_its_decoder_alone_and_is_read_in_blocks_if_that_can(
    tmp_path, read, in_blocks
):
    reads(ACCEL, role='velocity')(read)
    assert 'AccelStamped' in choices(ObserverNodeSettings, 'velocity_type')
    stamps_ns = recordings.stamps_ns()
    path = tmp_path / 'accel.mcap'
    with RecordingWriter(path) as writer:
        for number, stamp_ns in enumerate(stamps_ns):
            writer.write('/speed', ACCEL, accel_message(stamp_ns, number), stamp_ns)
        writer.write_observation(ObservationEvent(ros.STAMP_NS, np.array([1]), np.ones((1, 3))))
    with Recording(path) as recording:
        selected = recording.find_topics()
        items = list(recording.blocks(selected))
        velocities = [e for e in recording.events(selected) if isinstance(e, VelocityEvent)]
    assert any(isinstance(item, VelocityBlock) for item in items) == in_blocks
    assert [event.stamp_ns for event in velocities] == list(stamps_ns)
    expected = [[0.0, 0.0, 0.5, 1.0, 0.0, 0.1 * n] for n in range(len(stamps_ns))]
    assert_array_equal([event.body_velocity for event in velocities], expected)


@pytest.mark.usefixtures('beacons')
def test_what_doctor_hears_is_what_is_registered():
    live_inputs = pytest.importorskip('slam_observer_ros.nodes.live_inputs')
    heard = live_inputs.HeardTopic('/beacons', BEACONS, 1.0)
    heard.take(beacon_message(ros.STAMP_NS, [(3, 2.0, 0.0)]))
    assert heard.role == 'landmarks'
    assert "1 points, 1 with an id, in 'mast', as landmarks with -r" in heard.text()
