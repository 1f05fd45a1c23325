"""Public data sets become recordings whose measurements agree with their truth."""

from __future__ import annotations

from data_set_files import write_mrclam, write_plaza, write_starry_night
import numpy as np
import pytest
import scipy.io

from slam_observer_ros.common.errors import DataSetError
from slam_observer_ros.events import BEARING, ObservationEvent, RANGE, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.data_sets import (
    EPOCH_NS,
    load_graph,
    load_mrclam,
    load_plaza,
    load_starry_night,
)
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.writer import DataSet, write_data_set

SECOND_NS = 1_000_000_000


def point_errors(data_set: DataSet, poses: np.ndarray) -> np.ndarray:
    """Distances of all observed points, moved by the true (n, 4, 4) poses, from their truth."""
    place_of = {landmark_id: index for index, landmark_id in enumerate(data_set.landmarks.ids)}
    errors = []
    for event, pose in zip(data_set.observations, poses, strict=True):
        places = [place_of[landmark_id] for landmark_id in event.ids.tolist()]
        seen = se3.transform(pose, event.points)
        errors.append(np.linalg.norm(seen - data_set.landmarks.world_points[places], axis=1))
    return np.concatenate(errors)


class TestMrclam:
    def test_rows_with_one_stamp_are_one_observation(self, tmp_path):
        data_set = load_mrclam(write_mrclam(tmp_path / 'run'), 2)
        assert [event.stamp_ns for event in data_set.observations] == [
            1248444187157 * 10**6,
            1248444187159 * 10**6,
        ]
        first, second = data_set.observations
        assert first.ids.tolist() == [6, 7]
        np.testing.assert_allclose(first.points, [[0.0, 2.0, 0.0], [3.0, 0.0, 0.0]], atol=1e-12)
        assert second.ids.tolist() == [7]
        assert data_set.left_out == {'robot': 1, 'misread': 1}

    @pytest.mark.parametrize(
        ('measure', 'kind', 'points'),
        [
            ('bearing', BEARING, [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
            ('range', RANGE, [[2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]),
        ],
    )
    def test_only_directions_or_distances_are_left_where_asked_for(
        self, tmp_path, slam_observer, measure, kind, points
    ):
        folder, out = write_mrclam(tmp_path / 'run'), tmp_path / 'out.mcap'
        options = ('--robot', 2, '--measure', measure)
        slam_observer.succeed('convert', 'mrclam', folder, out, *options)
        with Recording(out) as recording:
            events = list(recording.events(recording.find_topics()))
        seen = next(event for event in events if isinstance(event, ObservationEvent))
        assert seen.kinds.tolist() == [kind, kind]
        np.testing.assert_allclose(seen.lines_of_sight, points, atol=1e-7)

    def test_commands_and_truth(self, tmp_path):
        data_set = load_mrclam(write_mrclam(tmp_path / 'run'), 2)
        assert data_set.velocity_stamps_ns[0] == 1248444187156 * 10**6
        assert data_set.body_velocities[0].tolist() == [0, 0, -0.25, 0.5, 0, 0]
        expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 0], [0, 0, 0, 1]]
        np.testing.assert_allclose(data_set.true_poses[0], expected, atol=1e-12)
        assert data_set.landmarks.ids.tolist() == [6, 7]
        assert data_set.landmarks.world_points.tolist() == [[1, 2, 0], [3, 4, 0]]

    def test_recording_holds_the_data_set_in_stamp_order(self, tmp_path):
        out = tmp_path / 'out.mcap'
        data_set = load_mrclam(write_mrclam(tmp_path / 'run'), 2)
        write_data_set(data_set, out)
        with Recording(out) as recording:
            selected = recording.find_topics()
            events = list(recording.events(selected))
            truth = recording.truth(selected)
        kinds = [VelocityEvent, ObservationEvent, ObservationEvent, VelocityEvent]
        assert [type(event) for event in events] == kinds
        np.testing.assert_array_equal(truth.stamps_ns, data_set.truth_stamps_ns)
        np.testing.assert_allclose(truth.poses, data_set.true_poses, atol=1e-12)
        np.testing.assert_array_equal(truth.landmarks.ids, [6, 7])

    def test_what_is_missing_is_named(self, tmp_path):
        with pytest.raises(DataSetError, match='no such directory'):
            load_mrclam(tmp_path / 'nowhere', 1)
        with pytest.raises(DataSetError, match='not an MRCLAM data set'):
            load_mrclam(tmp_path, 1)
        folder = write_mrclam(tmp_path / 'run')
        with pytest.raises(DataSetError, match='no robot 7; there are 2'):
            load_mrclam(folder, 7)
        (folder / 'Barcodes.dat').unlink()
        with pytest.raises(DataSetError, match=r'Barcodes\.dat: no such file'):
            load_mrclam(folder, 2)

    @pytest.mark.parametrize(
        'content', ['', '# a header', '1 2', '1 2 3 4 5', 'a b c d', '1 2\n3']
    )
    @pytest.mark.filterwarnings('error')
    def test_malformed_file_is_named(self, tmp_path, content):
        folder = write_mrclam(tmp_path / 'run')
        (folder / 'Robot2_Measurement.dat').write_text(content)
        with pytest.raises(DataSetError, match=r'Robot2_Measurement\.dat') as raised:
            load_mrclam(folder, 2)
        assert 'usecols' not in str(raised.value)

    @pytest.mark.parametrize('robot', [1, 2, 3, 4, 5])
    def test_real_measurements_agree_with_the_truth(self, data_dir, robot):
        data_set = load_mrclam(data_dir / 'mrclam' / 'MRCLAM_Dataset6', robot)
        stamps_ns = np.array([event.stamp_ns for event in data_set.observations])
        assert np.all(np.diff(stamps_ns) > 0)
        nearest = np.searchsorted(data_set.truth_stamps_ns, stamps_ns).clip(
            max=len(data_set.truth_stamps_ns) - 1
        )
        errors = point_errors(data_set, data_set.true_poses[nearest])
        # Range noise of 0.12 m and bearing noise of 0.02 rad at 2 to 7 m.
        assert np.median(errors) < 0.2
        assert data_set.left_out['misread'] <= 3
        assert data_set.left_out['robot'] > 300

    def test_real_commands_say_how_the_robot_moves(self, data_dir):
        data_set = load_mrclam(data_dir / 'mrclam' / 'MRCLAM_Dataset6', 1)
        seconds = (data_set.velocity_stamps_ns - data_set.velocity_stamps_ns[0]) / SECOND_NS
        path_length = np.sum(data_set.body_velocities[:-1, 3] * np.diff(seconds))
        steps = np.diff(data_set.true_poses[::50, :3, 3], axis=0)
        # Commands: true motion is 5 to 15 % less.
        assert 1.0 < path_length / np.linalg.norm(steps, axis=1).sum() < 1.2

    def test_a_run_without_ground_truth_becomes_a_recording_without(self, tmp_path, slam_observer):
        folder = write_mrclam(tmp_path / 'run')
        (folder / 'Robot2_Groundtruth.dat').unlink()
        (folder / 'Landmark_Groundtruth.dat').unlink()
        out = tmp_path / 'out.mcap'
        slam_observer.succeed('convert', 'mrclam', folder, '--robot', 2, out)
        with Recording(out) as recording:
            selected = recording.find_topics()
            assert len(list(recording.events(selected))) == 4
            truth = recording.truth(selected)
        assert not len(truth.stamps_ns)
        assert truth.landmarks is None


class TestPlaza:
    def test_the_way_is_a_mean_velocity_and_each_distance_an_observation(self, tmp_path):
        data_set = load_plaza(write_plaza(tmp_path / 'plaza'), 1)
        assert data_set.velocity_stamps_ns.tolist() == [10 * SECOND_NS, 10_500_000_000]
        expected = [[0, 0, 0.5, 1, 0, 0], [0, 0, 0, 2, 0, 0]]
        np.testing.assert_allclose(data_set.body_velocities, expected, atol=1e-12)
        first, last = data_set.observations
        assert (first.stamp_ns, first.ids.tolist()) == (10_100_000_000, [1])
        assert first.points.tolist() == [[3, 0, 0]]
        assert (last.stamp_ns, last.ids.tolist()) == (10_900_000_000, [5])
        assert last.kinds.tolist() == [RANGE]
        assert data_set.left_out == {'without a range': 1}
        assert data_set.landmarks.ids.tolist() == [1, 5]

    @pytest.mark.parametrize('turned', [0.0, np.pi])
    def test_the_true_heading_is_where_the_robot_drives(self, tmp_path, turned):
        data_set = load_plaza(write_plaza(tmp_path / 'plaza', turned), 1)
        np.testing.assert_allclose(data_set.true_poses[0, :3, 0], [1, 0, 0], atol=1e-6)

    def test_the_survey_and_the_start_are_printed_as_replay_takes_them(
        self, tmp_path, slam_observer, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        options = ('convert', 'plaza', write_plaza(tmp_path / 'plaza'), 'out.mcap', '--run', 1)
        output = slam_observer.succeed(*options).output
        words = ' '.join(line.split('│')[2] for line in output.splitlines() if '│' in line)
        given = [word for word in words[words.index('--load-map') :].split() if word]
        report = slam_observer.succeed('replay', 'out.mcap', '--config', 'uwb', '--json', *given)
        assert report.json['landmarks'] == 2
        assert '--force' in slam_observer.fail(*options)

    def test_a_run_without_truth_is_one_of_measurements(self, tmp_path, slam_observer):
        folder, out = write_plaza(tmp_path / 'plaza'), tmp_path / 'out.mcap'
        for name in ('gt', 'tl'):
            (folder / f'plaza1_{name}.csv').unlink()
        slam_observer.succeed('convert', 'plaza', folder, out, '--run', 1)
        assert not out.with_suffix('.yaml').exists()

    @pytest.mark.parametrize('content', ['', 't,a,b\n', 't,a,b\n1,2\n', 't,a,b\n1,x,3\n1,2,nan\n'])
    def test_what_is_wrong_is_named(self, tmp_path, content):
        folder = write_plaza(tmp_path / 'plaza')
        with pytest.raises(DataSetError, match=r'plaza3_dr\.csv: no such file'):
            load_plaza(folder, 3)
        with pytest.raises(DataSetError, match='no such directory'):
            load_plaza(tmp_path / 'nowhere', 1)
        (folder / 'plaza1_dr.csv').write_text(content)
        with pytest.raises(DataSetError, match=r'plaza1_dr\.csv'):
            load_plaza(folder, 1)


ISAM = """\
# a quarter turn to the left, then straight on
ODOMETRY 0 1 1 1 1.5707963267948966 10 0 0 10 0 100
LANDMARK 0 7 3 1 2 0 4
EDGE2 1 2 1 0 0 10 0 0 10 0 100
LANDMARK 2 7 0 -1 2 0 4

LANDMARK 2 5 1 1 2 1 4
EDGE2 0 2 9 9 0 10 0 0 10 0 100
"""
G2O = """\
VERTEX_SE2 0 0 0 0
VERTEX_XY 7 0 0
FIX 0
EDGE_SE2 0 1 1 1 1.5707963267948966 100 0 0 100 0 10000
EDGE_SE2 1 2 1 0 0 100 0 0 100 0 10000
EDGE_SE2 0 2 9 9 0 100 0 0 100 0 10000
EDGE_SE2_XY 0 7 3 1 4 0 16
EDGE_SE2_XY 2 7 0 -1 4 0 16
EDGE_SE2_XY 2 5 1 1 4 2 17
"""


class TestGraph:
    @pytest.mark.parametrize('text', [ISAM, G2O])
    def test_an_edge_is_a_second_of_constant_velocity_and_a_point_an_observation(
        self, tmp_path, text
    ):
        path = tmp_path / 'graph.txt'
        path.write_text(text)
        data_set = load_graph(path)
        assert data_set.velocity_stamps_ns.tolist() == [1 * SECOND_NS, 2 * SECOND_NS]
        motions = se3.exp(data_set.body_velocities)
        expected = [[[0, -1, 0, 1], [1, 0, 0, 1]], [[1, 0, 0, 1], [0, 1, 0, 0]]]
        np.testing.assert_allclose(motions[:, :2], expected, atol=1e-12)
        first, last = data_set.observations
        assert (first.stamp_ns, first.ids.tolist()) == (1 * SECOND_NS, [7])
        assert (last.stamp_ns, last.ids.tolist()) == (3 * SECOND_NS, [5, 7])
        assert last.points.tolist() == [[1, 1, 0], [0, -1, 0]]
        np.testing.assert_allclose(np.linalg.inv(first.covariances[0])[:2, :2], [[4, 0], [0, 16]])
        np.testing.assert_allclose(np.linalg.inv(last.covariances[0])[:2, :2], [[4, 2], [2, 17]])
        assert data_set.left_out == {'edge between poses that do not follow each other': 1}

    def test_the_recording_of_a_graph_replays_with_its_truth(self, tmp_path, slam_observer):
        (tmp_path / 'graph.txt').write_text(ISAM)
        (tmp_path / 'truth.txt').write_text(ISAM.replace('1 0 0 10', '2 0 0 10'))
        out = tmp_path / 'out.mcap'
        slam_observer.succeed(
            'convert', 'graph', tmp_path / 'graph.txt', out, '--truth', tmp_path / 'truth.txt'
        )
        with Recording(out) as recording:
            truth = recording.truth(recording.find_topics())
        np.testing.assert_allclose(truth.poses[:, :2, 3], [[0, 0], [1, 1], [1, 3]], atol=1e-12)
        assert truth.landmarks.ids.tolist() == [5, 7]
        np.testing.assert_allclose(truth.landmarks.world_points, [[0, 4, 0], [3, 1, 0]], atol=1e-6)
        options = ['--set', 'two_d_mode=true', '--set', 'confirmations=1', '--json']
        figures = slam_observer.succeed('replay', out, *options).json
        assert figures['ate_rmse_m'] is not None

    @pytest.mark.parametrize(
        ('text', 'reason'),
        [
            ('', 'no edge from one pose to the next'),
            ('LANDMARK 0 7 3 1 2 0 4', 'no edge from one pose to the next'),
            (ISAM.replace('EDGE2 1 2', 'EDGE2 0 1'), 'no edge from pose 1 to the next'),
            (ISAM.replace('EDGE2', 'EDGE3'), "line 4: 'EDGE3' is no line of a graph in the plane"),
            (ISAM.replace('3 1 2 0 4', '3 1 2 0'), 'line 3: LANDMARK has 7 numbers, not 6'),
            (ISAM.replace('3 1 2 0 4', '3 one 2 0 4'), 'line 3: no number'),
            (ISAM.replace('3 1 2 0 4', '3 nan 2 0 4'), 'line 3: it has a number beyond'),
            (ISAM.replace('LANDMARK 0 7', 'LANDMARK 0 -7'), 'line 3: 0 or -7 is no number of a'),
            (
                ISAM.replace('2 0 4', '2 0 0'),
                'of landmark 7 in pose 0 is not positive',
            ),
            ('\0' * 100, 'line 1'),
            ('é', 'no text'),
        ],
    )
    def test_what_is_wrong_with_a_graph_is_named(self, tmp_path, text, reason):
        path = tmp_path / 'graph.txt'
        path.write_text(text)
        with pytest.raises(DataSetError, match=reason) as caught:
            load_graph(path)
        assert str(path) in str(caught.value)

    def test_a_truth_of_another_graph_is_refused(self, tmp_path):
        (tmp_path / 'graph.txt').write_text(ISAM)
        (tmp_path / 'other.txt').write_text('EDGE2 0 1 1 0 0 10 0 0 10 0 100')
        with pytest.raises(DataSetError, match=r"other\.txt: its poses differ from the graph's"):
            load_graph(tmp_path / 'graph.txt', tmp_path / 'other.txt')
        with pytest.raises(DataSetError, match='no such file'):
            load_graph(tmp_path / 'missing.txt')

    @pytest.mark.parametrize(
        ('name', 'truth', 'sigma_m'),
        [
            ('victoria_park', 'victoria_park_batch', 0.632),
            ('city_trees_10000', 'city_trees_10000_groundtruth', 0.1),
        ],
    )
    def test_real_points_agree_with_the_truth(self, data_dir, name, truth, sigma_m):
        folder = data_dir / 'graphs'
        data_set = load_graph(folder / f'{name}.txt', folder / f'{truth}.txt')
        stamps_ns = [event.stamp_ns for event in data_set.observations]
        poses = data_set.true_poses[np.searchsorted(data_set.truth_stamps_ns, stamps_ns)]
        errors = point_errors(data_set, poses)
        # Half are within 1.18 σ where they are Gaussian; Victoria Park's are better than stated.
        assert 0.2 * sigma_m < np.median(errors) < 1.3 * sigma_m


class TestStarryNight:
    def test_one_point_by_hand(self, tmp_path):
        data_set = load_starry_night(write_starry_night(tmp_path / 'data.mat'))
        [observation] = data_set.observations  # The first frame sees nothing.
        assert observation.stamp_ns == EPOCH_NS + SECOND_NS // 4
        assert observation.ids.tolist() == [4]
        np.testing.assert_allclose(observation.points, [[2.1, 1.0, 0.5]], atol=1e-12)

    def test_velocities_and_truth(self, tmp_path):
        data_set = load_starry_night(write_starry_night(tmp_path / 'data.mat'))
        assert data_set.body_velocities[1].tolist() == [-0.4, -0.5, -0.6, 4, 5, 6]
        expected = [[0, -1, 0, 1], [1, 0, 0, 1], [0, 0, 1, 1], [0, 0, 0, 1]]
        np.testing.assert_allclose(data_set.true_poses[1], expected, atol=1e-12)
        assert data_set.landmarks.ids.tolist() == list(range(20))
        assert data_set.landmarks.world_points[4].tolist() == [4, 24, 44]

    def test_what_is_wrong_is_named(self, tmp_path):
        file = tmp_path / 'data.mat'
        with pytest.raises(DataSetError, match='no such file'):
            load_starry_night(file)
        file.write_text('no matrices at all' * 100)
        with pytest.raises(DataSetError, match='not a MATLAB file'):
            load_starry_night(file)
        whole = write_starry_night(file).read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(DataSetError, match='or damaged'):
            load_starry_night(file)
        scipy.io.savemat(file, {'t': np.zeros((1, 2))})
        with pytest.raises(DataSetError, match='it has no v_vk_vk_i'):
            load_starry_night(file)
        write_starry_night(file, r_i_vk_i=np.zeros((3, 5)))
        with pytest.raises(DataSetError, match=r'r_i_vk_i has shape \(3, 5\), not \(3, 2\)'):
            load_starry_night(file)

    def test_real_points_agree_with_the_truth(self, data_dir):
        data_set = load_starry_night(data_dir / 'starry_night' / 'dataset3.mat')
        seen = np.isin(
            data_set.truth_stamps_ns, [event.stamp_ns for event in data_set.observations]
        )
        errors = point_errors(data_set, data_set.true_poses[seen])
        assert np.median(errors) == pytest.approx(0.022, abs=0.001)
        assert np.percentile(errors, 95) == pytest.approx(0.082, abs=0.001)
        assert errors.max() == pytest.approx(0.91, abs=0.01)
        assert len(errors) / len(data_set.truth_stamps_ns) == pytest.approx(4.95, abs=0.01)

    def test_real_velocities_have_the_sign_of_the_true_motion(self, data_dir):
        data_set = load_starry_night(data_dir / 'starry_night' / 'dataset3.mat')
        seconds = np.diff(data_set.truth_stamps_ns) / SECOND_NS
        motion = se3.inverse(data_set.true_poses[:-1]) @ data_set.true_poses[1:]
        true_velocities = se3.log(motion) / seconds[:, None]
        for axis, least in enumerate([0.8, 0.6, 0.25, 0.8, 0.8, 0.8]):
            measured = data_set.body_velocities[:-1, axis]
            assert np.corrcoef(measured, true_velocities[:, axis])[0, 1] > least

    def test_real_recording_holds_every_event(self, data_dir, tmp_path):
        out = tmp_path / 'starry.mcap'
        data_set = load_starry_night(data_dir / 'starry_night' / 'dataset3.mat')
        write_data_set(data_set, out)
        with Recording(out) as recording:
            selected = recording.find_topics()
            events = list(recording.events(selected))
            truth = recording.truth(selected)
        velocities = [event for event in events if isinstance(event, VelocityEvent)]
        observations = [event for event in events if isinstance(event, ObservationEvent)]
        assert [event.stamp_ns for event in velocities] == data_set.velocity_stamps_ns.tolist()
        for read, written in zip(observations, data_set.observations, strict=True):
            assert read.stamp_ns == written.stamp_ns
            np.testing.assert_array_equal(read.ids, written.ids)
            np.testing.assert_allclose(read.points, written.points, rtol=1e-6)
        np.testing.assert_allclose(truth.poses, data_set.true_poses, atol=1e-12)
        rotations = truth.poses[:, :3, :3]
        np.testing.assert_allclose(rotations, so3.normalise(rotations), atol=1e-12)
