"""Files of data sets and recordings, a few bytes of which are wrong: read, or refused."""

from __future__ import annotations

from collections.abc import Callable
import os
import shutil
import warnings

from data_set_files import write_mrclam, write_starry_night
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from slam_observer_ros.common.errors import DataSetError, RecordingError
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.recordings.data_sets import load_graph, load_mrclam, load_starry_night
from slam_observer_ros.recordings.opening import MAX_METADATA_BYTES
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.writer import DataSet, RecordingWriter

GRAPH = """\
EDGE2 0 1 1 1 1.5707963267948966 10 0 0 10 0 100
LANDMARK 0 7 3 1 2 0 4
ODOMETRY 1 2 1 0 0 10 0 0 10 0 100
LANDMARK 2 7 0 -1 2 0 4
"""

MAX_STAMP_NS = 2**32 * 10**9

NUMBERS = ('nan', 'inf', '-inf', '1e308', '-1e308', '1e19', '-3', '0', '7.5', '', 'x', '9' * 30)


@st.composite
def damages(draw) -> Callable[[bytes], bytes]:
    """Draw what happens to a file: bytes that change, a number that does, or an early end."""
    places = st.floats(0.0, 1.0, exclude_max=True)
    if draw(st.booleans()):
        share, number = draw(places), draw(st.sampled_from(NUMBERS))

        def replace_word(content: bytes) -> bytes:
            words = content.split(b' ')
            words[int(share * len(words))] = number.encode()
            return b' '.join(words)

        return replace_word
    changes = draw(st.lists(st.tuples(places, st.integers(0, 255)), max_size=4))
    end = draw(st.just(1.0) | places)

    def change_bytes(content: bytes) -> bytes:
        changed = bytearray(content)
        for share, byte in changes:
            changed[int(share * len(changed))] = byte
        return bytes(changed[: round(end * len(changed))])

    return change_bytes


def is_sound(data_set: DataSet) -> bool:
    """Return whether what was read is all finite, at stamps that ROS can have."""
    events = data_set.observations
    arrays = [data_set.body_velocities, data_set.true_poses, data_set.landmarks.world_points]
    stamps_ns = [*data_set.velocity_stamps_ns.tolist(), *(event.stamp_ns for event in events)]
    return all(np.isfinite(array).all() for array in arrays) and all(
        0 <= stamp_ns < MAX_STAMP_NS for stamp_ns in stamps_ns
    )


def is_read_or_refused(load: Callable[[], DataSet]) -> None:
    """Hold that a data set is sound or refused in one line, without a warning of numpy's."""
    with warnings.catch_warnings():
        warnings.simplefilter('error', RuntimeWarning)
        try:
            data_set = load()
        except DataSetError as error:
            assert '\n' not in str(error)
        else:
            assert is_sound(data_set)


@given(st.data(), damages())
def test_a_damaged_run_of_mrclam(tmp_path_factory, data, damage):
    folder = write_mrclam(tmp_path_factory.mktemp('mrclam') / 'run')
    file = data.draw(st.sampled_from(sorted(folder.iterdir())))
    file.write_bytes(damage(file.read_bytes()))
    is_read_or_refused(lambda: load_mrclam(folder, 2))


@given(st.floats(0.0, 1.0, exclude_max=True))
def test_a_file_of_starry_night_that_is_cut_off(tmp_path_factory, share):
    """No other damage: the reader of MATLAB files, which is SciPy's, crashes on some."""
    file = write_starry_night(tmp_path_factory.mktemp('starry') / 'dataset3.mat')
    os.truncate(file, int(share * file.stat().st_size))
    is_read_or_refused(lambda: load_starry_night(file))


@pytest.mark.parametrize(
    'changes',
    [
        {'t': np.array([[np.nan, 0.25]])},
        {'t': np.array([[0.0, 1e300]])},
        {'t': np.array([['a', 'b']])},
        {'t': np.array([[1j, 2.0]])},
        {'b': np.inf},
        {'rho_i_pj_i': np.array([['x'] * 20] * 3, dtype=object)},
        {'y_k_j': np.ones((4, 2, 20))},
    ],
)
def test_numbers_that_no_recording_has_are_refused(tmp_path, changes):
    file = write_starry_night(tmp_path / 'dataset3.mat', **changes)
    with pytest.raises(DataSetError):
        load_starry_night(file)


@given(damages())
def test_a_damaged_graph(tmp_path_factory, damage):
    file = tmp_path_factory.mktemp('graph') / 'graph.txt'
    file.write_bytes(damage(GRAPH.encode()))
    is_read_or_refused(lambda: load_graph(file))


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Make a rosbag2 directory with one file, without metadata."""
    folder = tmp_path_factory.mktemp('bag') / 'run'
    folder.mkdir()
    with RecordingWriter(folder / 'run_0.mcap') as writer:
        for stamp_ns in range(10):
            writer.write_velocity(VelocityEvent(stamp_ns + 10**18, np.zeros(6)))
    return folder


class TestMetadata:
    METADATA = (
        'rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n'
        '  relative_file_paths: [run_0.mcap]\n  message_count: 10\n'
    )

    @given(damage=damages())
    def test_damaged_metadata_of_one_file(self, whole, damage):
        (whole / 'metadata.yaml').write_bytes(damage(self.METADATA.encode()))
        try:
            with Recording(whole) as recording:
                assert recording.message_count == 10
        except RecordingError as error:
            assert '\n' not in str(error)

    @pytest.mark.parametrize(
        'content',
        [
            'a: &a [x, x]\nb: &b [*a, *a]\nrosbag2_bagfile_information: *b\n',
            'rosbag2_bagfile_information: {relative_file_paths: !!bool x}\n',
            'rosbag2_bagfile_information: &a {relative_file_paths: [*a]}\n',
            '[' * 10_000,
        ],
    )
    def test_hostile_metadata_of_one_file_does_not_matter(self, whole, content):
        (whole / 'metadata.yaml').write_text(content)
        with Recording(whole) as recording:
            assert recording.message_count == 10

    def test_metadata_larger_than_any_is_refused(self, whole, tmp_path):
        shutil.copy(whole / 'run_0.mcap', tmp_path)
        with (tmp_path / 'metadata.yaml').open('wb') as file:
            file.truncate(MAX_METADATA_BYTES + 1)
        with pytest.raises(RecordingError, match='it has more than 10 MB'):
            Recording(tmp_path)

    def test_metadata_that_is_no_file_is_refused(self, whole, tmp_path):
        shutil.copy(whole / 'run_0.mcap', tmp_path)
        os.mkfifo(tmp_path / 'metadata.yaml')
        with pytest.raises(RecordingError, match=r'metadata\.yaml is no file'):
            Recording(tmp_path)
