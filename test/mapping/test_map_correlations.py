"""Correlations between the landmarks of a map: in its file, and in the run that loads it."""

from __future__ import annotations

import base64
from dataclasses import replace
import re
import zlib

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from random_runs import covariance_of_all, observe, PLAIN, random_covariances, random_step
from strategies import generators
import yaml

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.riccati.active_landmarks import BlockSize
from slam_observer_ros.filter.riccati.riccati import RiccatiGains
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import PLANAR
from slam_observer_ros.lie.matrices import diagonal_blocks
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.mapping import map_file, merging
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.models.observation_noise import RESOLUTION_RAD
from slam_observer_ros.settings.estimator_settings import Settings

TWO_D = replace(PLAIN, two_d_mode=True)


def random_joint(rng, n, m2=1e-2, is_planar=False):
    joint = m2 * random_covariances(rng, 1, 3 * n)[0]
    if is_planar:
        joint[2::3] = joint[:, 2::3] = 0.0
    return joint


def a_map(n=6, seed=0, is_planar=False):
    rng = np.random.default_rng(seed)
    joint = random_joint(rng, n, is_planar=is_planar)
    return LandmarkMap(
        10 * np.arange(n)[::-1],
        rng.uniform(-9.0, 9.0, (n, 3)),
        diagonal_blocks(joint, 3).copy(),
        rng.integers(1, 100, n),
        joint_covariance=joint,
    )


def write(path, landmark_map):
    write_map(path, landmark_map, None)
    return path


class TestFile:
    @pytest.mark.parametrize('is_planar', [False, True])
    def test_it_is_read_back_bit_for_bit_and_written_again_as_it_was(self, tmp_path, is_planar):
        known = a_map(is_planar=is_planar)
        path = write(tmp_path / 'map.yaml', known)
        assert_array_equal(read_map(path).joint_covariance, known.joint_covariance)
        again = write(tmp_path / 'again.yaml', read_map(path))
        assert again.read_bytes() == path.read_bytes()

    def test_anybody_can_read_them_as_the_documentation_says(self, tmp_path):
        known = a_map()
        content = yaml.safe_load(write(tmp_path / 'map.yaml', known).read_text())
        n = 3 * len(content['landmarks'])
        P = np.zeros((n, n))
        data = zlib.decompress(base64.b64decode(content['correlations']['data']))
        P[np.tril_indices(n)] = np.frombuffer(data, '<f8')
        assert_array_equal(P + np.tril(P, -1).T, known.joint_covariance)

    def test_they_are_one_line_and_without_it_errors_are_independent(self, tmp_path):
        path = write(tmp_path / 'map.yaml', a_map())
        lines = path.read_text().splitlines(keepends=True)
        assert [line[:13] for line in lines].count('correlations:') == 1
        path.write_text(''.join(line for line in lines if not line.startswith('correlations:')))
        assert read_map(path).joint_covariance is None
        assert_array_equal(read_map(path).covariances, a_map().covariances)

    def test_those_of_too_many_landmarks_are_left_out_with_a_warning(
        self, tmp_path, monkeypatch, caplog
    ):
        monkeypatch.setattr(map_file, 'MAX_CORRELATED', 5)
        path = write(tmp_path / 'map.yaml', a_map(6))
        assert 'Correlations between the 6 landmarks of the map are not saved' in caplog.text
        assert read_map(path).joint_covariance is None
        caplog.clear()
        assert read_map(write(path, a_map(5))).joint_covariance is not None
        assert not caplog.text

    @pytest.mark.parametrize(
        ('pattern', 'replacement'),
        [
            (r'- \{id: 20, .*\n', ''),  # removed
            (r'(landmarks:\n)', r'\1- {id: 7, position: [0, 0, 0], sigma: 1}\n'),  # added
            (r'(id: 20, position: \[)[^,]*', r'\g<1>1.5'),  # moved
            (r'id: 20,', 'id: 21,'),  # renamed
            (r'(id: 20, .*)covariance: .*\]\]', r'\1sigma: 0.01'),  # better known
            (r'(- .*\n)(- .*\n)', r'\2\1'),  # in another order
        ],
    )
    def test_of_a_map_changed_by_hand_they_are_refused_with_what_to_do(
        self, tmp_path, pattern, replacement
    ):
        path = write(tmp_path / 'map.yaml', a_map())
        changed, count = re.subn(pattern, replacement, path.read_text(), count=1)
        assert count == 1
        path.write_text(changed)
        with pytest.raises(MapError) as caught:
            read_map(path)
        message = str(caught.value)
        assert str(path) in message
        assert 'a landmark was added, removed, moved or changed since' in message
        assert "delete the line that begins with 'correlations:'" in message
        assert '\n' not in message

    def test_how_often_landmarks_were_seen_and_the_frame_may_be_changed(self, tmp_path):
        path = write(tmp_path / 'map.yaml', a_map())
        text = re.sub('observations: [0-9]*', 'observations: 3', path.read_text())
        path.write_text(text.replace('frame: map', 'frame: hall'))
        assert read_map(path).joint_covariance is not None

    @pytest.mark.parametrize(
        ('broken', 'reason'),
        [
            (lambda data: data[:-40], 'damaged|does not have'),
            (lambda data: data[:50] + ('A' if data[50] != 'A' else 'B') + data[51:], 'damaged'),
            (lambda data: data[:50] + '?' + data[51:], 'damaged'),
            (lambda data: data + data, 'damaged|does not have'),
            (lambda data: packed(np.zeros(5)), "'data' does not have 1368 bytes, as of 6 posi"),
            (lambda data: packed(np.zeros(10**6)), "'data' does not have 1368 bytes"),
            (lambda data: packed(np.full(171, np.nan)), 'an entry is NaN or infinite'),
            (lambda data: packed(np.zeros(171)), 'a landmark has another covariance there'),
        ],
    )
    def test_damaged_ones_are_refused_in_a_line(self, tmp_path, broken, reason):
        path = write(tmp_path / 'map.yaml', a_map())
        text = path.read_text()
        (data,) = re.findall('data: "(.*)"', text)
        path.write_text(text.replace(data, broken(data)))
        with pytest.raises(MapError, match=reason) as caught:
            read_map(path)
        assert 'delete the line' in str(caught.value)
        assert '\n' not in str(caught.value)

    @pytest.mark.parametrize(
        ('line', 'reason'),
        [
            ('correlations: 3', 'not of the form'),
            ('correlations: {data: x}', 'not of the form'),
            ('correlations: {checksum: 3, data: x}', 'was added, removed, moved'),
        ],
    )
    def test_what_are_none_is_refused(self, tmp_path, line, reason):
        path = write(tmp_path / 'map.yaml', a_map())
        path.write_text(re.sub('correlations: .*', line, path.read_text()))
        with pytest.raises(MapError, match=reason):
            read_map(path)

    @given(st.data())
    def test_with_a_wrong_byte_they_are_refused_or_as_they_were(self, tmp_path_factory, data):
        path = write(tmp_path_factory.mktemp('map') / 'map.yaml', a_map())
        whole = bytearray(path.read_bytes())
        start = whole.index(b': {checksum')
        whole[data.draw(st.integers(start, len(whole) - 1))] = data.draw(st.integers(0, 255))
        path.write_bytes(bytes(whole))
        try:
            read = read_map(path)
        except MapError as error:
            assert '\n' not in str(error)
        else:
            assert_array_equal(read.joint_covariance, a_map().joint_covariance)

    def test_those_that_no_errors_can_have_are_refused(self, tmp_path):
        known = a_map()
        joint = known.joint_covariance.copy()
        joint[0, 3] = joint[3, 0] = 2.0 * np.sqrt(joint[0, 0] * joint[3, 3])
        path = write(tmp_path / 'map.yaml', replace(known, joint_covariance=joint))
        with pytest.raises(MapError, match='they are negative in some direction'):
            read_map(path)
        with pytest.raises(MapError, match='joint map covariance: they are negative in some'):
            Estimator(Settings()).load_map(replace(known, joint_covariance=joint))
        joint[0, 3] = 0.0
        with pytest.raises(MapError, match='joint map covariance: they are not symmetric'):
            Estimator(Settings()).load_map(replace(known, joint_covariance=joint))
        with pytest.raises(MapError, match='needs the covariances of its landmarks'):
            Estimator(Settings()).load_map(replace(known, covariances=None))


class TestInAnotherFrame:
    def test_of_a_part_it_is_the_part(self):
        known = a_map()
        part = known.select(np.array([4, 1]))
        columns = [12, 13, 14, 3, 4, 5]
        assert_array_equal(part.joint_covariance, known.joint_covariance[np.ix_(columns, columns)])
        assert_array_equal(diagonal_blocks(part.joint_covariance, 3), part.covariances)
        assert_array_equal(known.select(known.ids > 20).joint_covariance.shape, (9, 9))

    def test_it_turns_with_the_frame(self):
        known, T = a_map(), se3.exp(np.array([0.3, -0.5, 1.0, 4.0, 5.0, 6.0]))
        there = KnownLandmarks(
            known.world_points, known.covariances, known.joint_covariance
        ).moved(T)
        turn = np.kron(np.eye(6), T[:3, :3])
        assert_allclose(there.joint, turn @ known.joint_covariance @ turn.T, atol=1e-12)
        assert_allclose(diagonal_blocks(there.joint, 3), there.covariances, atol=1e-12)
        assert_array_equal(
            there.covariance_on(PLANAR)[:4, :4],
            there.joint[np.ix_([0, 1, 3, 4], [0, 1, 3, 4])],
        )


def mapped(rng, settings, n=8, design=RiccatiGains):
    """A filter that has seen n landmarks, and moved."""
    flat = np.array([1.0, 1.0, not settings.two_d_mode])
    filter_ = make_gains(settings, np.eye(4), design)
    filter_.add(rng.uniform(-5.0, 5.0, (n, 3)) * flat, 0.01 * random_covariances(rng, n, 3))
    for _ in range(4):
        random_step(filter_, rng, 1e-3, 1e-2)
    return filter_


def known_by_a_map(rng, filter_, rows, others):
    """What a map knows of ``rows``, within a micrometre of the estimate, and of others."""
    flat = np.array([1.0, 1.0, filter_.axes.p != 3])
    off = 1e-6 * rng.standard_normal((len(rows), 3)) * flat
    more = rng.uniform(-9.0, 9.0, (others, 3)) * flat
    points = np.vstack([filter_.observer.points[rows] + off, more])
    joint = random_joint(rng, len(points))
    return KnownLandmarks(points, diagonal_blocks(joint, 3).copy(), joint)


@pytest.mark.parametrize('settings', [PLAIN, TWO_D], ids=['3D', 'planar'])
@given(generators())
def test_a_map_is_entered_as_by_a_kalman_filter_of_all_errors_together(settings, rng):
    """The gauge of the estimate is one more error there, of which all but nothing is known."""
    filter_, rows = mapped(rng, settings), np.array([6, 1, 3, 4])
    known = known_by_a_map(rng, filter_, rows, others=3)
    p, k, points = filter_.axes.p, filter_.axes.point, filter_.observer.points
    own, n = covariance_of_all(filter_), len(points)
    G = np.vstack([np.eye(p), filter_.axes.output_matrix(points).reshape(-1, p)])
    R = known.covariance_on(filter_.axes)
    # (ε, ã_i of the estimate, those of the map) before, and minus their differences after.
    P = np.zeros((p + k * (n + 7),) * 2)
    P[: len(own), : len(own)] = own + 1e5 * G @ G.T
    P[len(own) :, len(own) :] = R
    H = np.zeros((4 * k, len(P)))
    H[:, len(own) : len(own) + 4 * k] = -np.eye(4 * k)
    for at, row in enumerate(rows):
        H[k * at : k * (at + 1), p + k * row : p + k * (row + 1)] = np.eye(k)
    P -= P @ H.T @ np.linalg.solve(H @ P @ H.T + 1e-12 * np.eye(4 * k), H @ P)
    kept = np.append(np.arange(len(own)), np.arange(len(own) + 4 * k, len(P)))
    filter_.enter_map(rows, known)
    assert_allclose(covariance_of_all(filter_), P[np.ix_(kept, kept)], atol=1e-6)
    assert_allclose(filter_.observer.points[rows], known.points[:4], atol=1e-5)
    assert_allclose(filter_.observer.points[n:], known.points[4:], atol=1e-5)


class Compressed(RiccatiGains):
    """A filter whose map is soon taken for a large one."""

    block = BlockSize(dense=5, most=6, kept=3, kept_per_seen=1)


@pytest.mark.parametrize('settings', [PLAIN, TWO_D], ids=['3D', 'planar'])
@given(generators())
def test_independent_errors_are_correlated_ones_without_correlation(settings, rng):
    filters = [
        mapped(np.random.default_rng(1), settings, design=design)
        for design in (RiccatiGains, RiccatiGains, Compressed)
    ]
    rows = np.array([6, 1, 3, 4])
    known = known_by_a_map(rng, filters[0], rows, others=3)
    independent = np.zeros_like(known.joint)
    diagonal_blocks(independent, 3)[:] = known.covariances
    filters[0].enter_map(rows, replace(known, joint=None))
    for filter_ in filters[1:]:
        filter_.enter_map(rows, replace(known, joint=independent))
        assert_allclose(filter_.observer.points, filters[0].observer.points, atol=1e-7)
        assert_allclose(covariance_of_all(filter_), covariance_of_all(filters[0]), atol=1e-9)
    assert not filters[2].joint.is_dense


@pytest.mark.parametrize('settings', [PLAIN, TWO_D], ids=['3D', 'planar'])
@given(generators())
def test_a_large_map_is_started_in_and_entered_as_a_small_one(settings, rng):
    noise = 0.01 * random_covariances(rng, 3, 3)
    for rows in (np.array([], dtype=np.int64), np.array([6, 1, 3, 4])):
        pair = [
            mapped(np.random.default_rng(1), settings, design=design)
            for design in (RiccatiGains, Compressed)
        ]
        known = known_by_a_map(rng, pair[0], rows, others=9)
        for filter_ in pair:
            filter_.enter_map(rows, known) if len(rows) else filter_.add_known(known)
            seen = np.array([0, 5, 9])
            for _ in range(3):
                observe(filter_, seen, filter_.observer.body_points(seen) + 0.01, noise)
        assert not pair[1].joint.is_dense
        assert_allclose(pair[1].observer.points, pair[0].observer.points, atol=1e-7)
        assert_allclose(covariance_of_all(pair[1]), covariance_of_all(pair[0]), atol=1e-7)


def placed(known, mode, gains='riccati', two_d_mode=False):
    """An estimator in a map, its pose given."""
    settings = Settings(
        gains=gains, localization_mode=mode, reorder_window=0.0, two_d_mode=two_d_mode
    )
    estimator = Estimator(settings)
    estimator.load_map(known, np.eye(4), 0.01 * np.eye(6))
    return estimator


@pytest.mark.parametrize('two_d_mode', [False, True])
@pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
def test_what_is_loaded_can_be_saved(mode, two_d_mode):
    known = a_map(is_planar=two_d_mode)
    if two_d_mode:
        known = known.flattened()
    saved = placed(known, mode, two_d_mode=two_d_mode).landmark_map
    assert_array_equal(np.sort(saved.ids), np.sort(known.ids))
    of_known = known.select([known.ids.tolist().index(i) for i in saved.ids])
    assert_allclose(saved.joint_covariance, of_known.joint_covariance, atol=2e-8)
    assert_allclose(saved.covariances, diagonal_blocks(saved.joint_covariance, 3), atol=0.0)


@pytest.mark.parametrize('is_loaded', [False, True])
def test_in_too_large_a_map_only_covariances_are_known_and_the_log_says_so(
    monkeypatch, caplog, is_loaded
):
    monkeypatch.setattr(merging, 'MAX_CORRELATED', 5)
    known = a_map(6)
    estimator = Estimator(Settings(reorder_window=0.0, confirmations=1))
    if is_loaded:
        estimator.load_map(known, np.eye(4), 0.01 * np.eye(6))
    else:
        estimator.add(ObservationEvent(0, known.ids, known.world_points))
    saved = estimator.landmark_map
    assert saved.joint_covariance is None
    assert saved.covariances.shape == (6, 3, 3)
    assert 'Correlations between the 6 landmarks of the map are not saved' in caplog.text


def test_in_a_fixed_map_they_stay_as_they_were_whatever_is_seen():
    known = a_map()
    estimator = placed(known, 'fixed')
    estimator.add(ObservationEvent(0, known.ids[:4], known.world_points[:4]))
    assert_array_equal(estimator.landmark_map.joint_covariance, known.joint_covariance)
    assert estimator.forget(int(known.ids[2]))
    kept = known.select(np.array([0, 1, 3, 4, 5]))
    assert_array_equal(estimator.landmark_map.joint_covariance, kept.joint_covariance)


def test_gains_without_a_joint_covariance_take_errors_for_independent():
    known, saved = a_map(), []
    for landmark_map in (known, replace(known, joint_covariance=None)):
        estimator = placed(landmark_map, 'uncertain', 'constant')
        for step in range(3):
            points = known.world_points[:4] + 0.1
            estimator.add(ObservationEvent(step * 10**8, known.ids[:4], points))
        saved.append(estimator.landmark_map)
    assert saved[0].joint_covariance is None
    assert_array_equal(saved[0].world_points, saved[1].world_points)


def tag_map(seed=0):
    """Six landmarks, of which three are tags, with the joint covariance of all."""
    rng, known = np.random.default_rng(seed), a_map(seed=seed)
    R = so3.exp(rng.normal(size=(6, 3)))
    R[[0, 2, 5]] = 0.0
    joint = random_joint(rng, 9)
    sigmas = np.zeros(6)
    sigmas[[1, 3, 4]] = np.sqrt(np.linalg.eigvalsh(diagonal_blocks(joint[18:, 18:], 3))[:, -1])
    return replace(
        known,
        covariances=diagonal_blocks(joint[:18, :18], 3).copy(),
        orientations=R,
        orientation_sigmas=sigmas,
        joint_covariance=joint,
    )


class TestTags:
    """Orientations have errors in common with positions."""

    TAGS = Settings(use_tag_orientation=True, reorder_window=0.0, localization_mode='uncertain')

    def test_the_file_has_them_too(self, tmp_path):
        known = tag_map()
        path = write(tmp_path / 'map.yaml', known)
        assert_array_equal(read_map(path).joint_covariance, known.joint_covariance)
        positions_only = re.sub('orientation.*}', '}', path.read_text())
        path.write_text(positions_only.replace(', }', '}'))
        with pytest.raises(MapError, match='a landmark was added, removed, moved or changed'):
            read_map(path)

    def test_a_part_has_those_of_its_tags(self):
        part = tag_map().select(np.array([4, 0, 1]))
        columns = np.array([[3 * i, 3 * i + 1, 3 * i + 2] for i in (4, 0, 1, 8, 6)]).ravel()
        assert_array_equal(
            part.joint_covariance, tag_map().joint_covariance[np.ix_(columns, columns)]
        )

    @pytest.mark.parametrize('use_tag_orientation', [False, True])
    @pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
    def test_what_is_loaded_can_be_saved(self, mode, use_tag_orientation):
        known = tag_map()
        estimator = Estimator(
            replace(self.TAGS, localization_mode=mode, use_tag_orientation=use_tag_orientation)
        )
        estimator.load_map(known, np.eye(4), 0.01 * np.eye(6))
        saved = estimator.landmark_map
        known = known.select([known.ids.tolist().index(i) for i in saved.ids])
        size = 27 if use_tag_orientation or mode == 'fixed' else 18
        assert_allclose(saved.joint_covariance, known.joint_covariance[:size, :size], atol=2e-8)
        if size == 27:
            assert_allclose(saved.orientations, known.orientations, atol=1e-12)
            assert_allclose(saved.orientation_sigmas, known.orientation_sigmas, atol=1e-5)

    @pytest.mark.parametrize('two_d_mode', [False, True])
    @given(generators())
    def test_a_map_is_entered_as_by_a_kalman_filter_of_all_errors_together(self, two_d_mode, rng):
        settings = replace(PLAIN, use_tag_orientation=True, two_d_mode=two_d_mode)
        filter_ = mapped(rng, settings, n=6, design=RiccatiGains)
        see_tags(rng, filter_, np.array([0, 1, 3]))
        # Of 3 both know how it is turned, of 0 and 1 the estimate alone, of 5 the map alone.
        rows, known = np.array([3, 1, 5, 0]), known_by_a_tag_map(rng, filter_)
        axes, points = filter_.axes, filter_.observer.points
        p, k, q, n = axes.p, axes.point, axes.turn, len(points)
        stride = k + q
        own = filter_.joint.of_positions(points)
        G = np.zeros((len(own), p))
        G[:p] = np.eye(p)
        for i, J in enumerate(axes.output_matrix(points)):
            G[p + stride * i :][:k] = J
            G[p + stride * i + k :][:q] = np.eye(q, p)
        R = known.joint_on(axes)
        P = np.zeros((len(own) + len(R),) * 2)
        P[: len(own), : len(own)] = own + 1e6 * G @ G.T
        P[len(own) :, len(own) :] = R
        H = np.zeros((4 * k + q, len(P)))
        for i, row in enumerate(rows):
            H[k * i : k * (i + 1), p + stride * row :][:, :k] = np.eye(k)
        H[: 4 * k, len(own) :][:, : 4 * k] = -np.eye(4 * k)
        H[4 * k :, p + stride * 3 + k :][:, :q] = np.eye(q)
        H[4 * k :, len(own) + 6 * k :][:, :q] = -np.eye(q)
        noise = np.diag(np.append(np.full(4 * k, 1e-12), np.full(q, RESOLUTION_RAD**2)))
        P -= P @ H.T @ np.linalg.solve(H @ P @ H.T + noise, H @ P)
        filter_.enter_map(rows, known)
        # The pose, the positions of the estimate and of the two that are new, and all turns.
        first, turns = len(own), len(own) + 6 * k
        points_at = np.append(p + stride * np.arange(n), first + k * np.arange(4, 6))
        turns_at = np.append(p + stride * np.array([0, 1, 3]) + k, turns + q * np.arange(1, 3))
        expected_at = [np.arange(p), ranges(points_at, k), ranges(turns_at, q)]
        # Where the filter has them: of landmark 5 and the last of the new ones it took the map's.
        at = p + stride * np.arange(n + 2)
        found_at = [np.arange(p), ranges(at, k), ranges(at[[0, 1, 3, 5, 7]] + k, q)]
        found = filter_.joint.of_positions(filter_.observer.points)
        expected_at, found_at = np.concatenate(expected_at), np.concatenate(found_at)
        assert_allclose(
            found[np.ix_(found_at, found_at)], P[np.ix_(expected_at, expected_at)], atol=1e-6
        )
        assert_array_equal(filter_.observer.orientations.are_known, [1, 1, 0, 1, 0, 1, 0, 1])
        assert_allclose(
            filter_.observer.orientations.B[[5, 7]], known.orientations[[2, 5]], atol=1e-5
        )


def ranges(starts, count):
    return (starts[:, None] + np.arange(count)).ravel()


def see_tags(rng, filter_, rows):
    """Let the filter see how landmarks are turned, for the first time, and then move."""
    turns = np.zeros((len(rows), 3))
    turns[:, filter_.axes.turned] = rng.normal(size=(len(rows), filter_.axes.turn))
    noise = 1e-3 * random_covariances(rng, len(rows), 3)
    Z = so3.exp(turns)
    filter_.add_orientations(SeenOrientations(rows, Z, Z, noise, np.ones(len(rows))))
    random_step(filter_, rng, 1e-3, 1e-2)


def known_by_a_tag_map(rng, filter_):
    """What a map knows of 3, 1, 5 and 0, and of two others; 3, 5 and the last are tags."""
    known = known_by_a_map(rng, filter_, np.array([3, 1, 5, 0]), others=2)
    joint = random_joint(rng, 9)
    R = np.zeros((6, 3, 3))
    R[0], R[2], R[5] = filter_.observer.orientations.B[3], np.eye(3), np.eye(3)
    return replace(
        known,
        covariances=diagonal_blocks(joint[:18, :18], 3).copy(),
        joint=joint,
        orientations=R,
        sigmas=np.full(6, 0.1),
    )


SPACING_M, STEP_S, SPEED_M_S = 2.0, 0.2, 1.0


class Corridor:
    """Landmarks on both sides of a straight way, along which odometry bends what is mapped."""

    LENGTH_M = 24.0
    VIEW_M = 4.0
    POINT_NOISE_M = 0.03
    NOISE = np.array([0.0, 0.0, 0.01, 0.03, 0.03, 0.0])  # rad and m per √s

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        x = np.arange(-2.0, self.LENGTH_M + 2.0, SPACING_M)
        ends = np.array([np.append(x, x), np.repeat([2.0, -2.0], len(x))]).T
        self.points = np.zeros((len(ends), 3))
        self.points[:, :2] = ends + self.rng.uniform(-0.5, 0.5, ends.shape)

    def settings(self, **changes):
        turns, shifts = np.split(self.NOISE, 2)
        return Settings(
            two_d_mode=True,
            observation_model='cartesian',
            point_noise=self.POINT_NOISE_M,
            angular_velocity_noise=tuple(turns),
            linear_velocity_noise=tuple(shifts),
            angular_bias_stddev=(0.0, 0.0, 0.0),
            huber_threshold=0.0,
            reorder_window=0.0,
            **changes,
        )

    def drive(self, estimator, start_s=0.0):
        """Drive along; yield the time after each observation."""
        V = np.array([0.0, 0.0, 0.0, SPEED_M_S, 0.0, 0.0])
        for step in range(round(self.LENGTH_M / SPEED_M_S / STEP_S)):
            stamp_ns = round((start_s + step * STEP_S) * 1e9)
            seen = self.points - [step * STEP_S * SPEED_M_S, 0.0, 0.0]
            rows = np.flatnonzero(np.linalg.norm(seen, axis=1) < self.VIEW_M)
            noise = self.rng.normal(size=(len(rows), 3)) * [1.0, 1.0, 0.0] * self.POINT_NOISE_M
            estimator.add(ObservationEvent(stamp_ns, rows, seen[rows] + noise))
            yield step * STEP_S
            error = self.NOISE * self.rng.standard_normal(6) / np.sqrt(STEP_S)
            estimator.add(VelocityEvent(stamp_ns, V + error))

    def mapped(self):
        estimator = Estimator(self.settings())
        for _ in self.drive(estimator):
            pass
        return estimator.landmark_map

    def frame_of(self, known):
        """Where the map's frame is in the corridor: as its landmarks say, by their covariance."""
        truth, k = self.points[known.ids], 2
        columns = (3 * np.arange(len(known.ids))[:, None] + np.arange(k)).ravel()
        # Of the error of a map's shape the covariance says it is at right angles to three
        # directions: it has no variance along these.
        N = np.linalg.eigh(known.joint_covariance[np.ix_(columns, columns)])[1][:, :3]
        T = rigid_alignment(truth, known.world_points)
        for _ in range(5):
            errors = (known.world_points - se3.transform(T, truth))[:, :k].ravel()
            G = PLANAR.output_matrix(known.world_points).reshape(-1, 3)
            T = se3.exp(PLANAR.full_pose(np.linalg.solve(N.T @ G, N.T @ errors))) @ T
        return T


def test_in_the_map_of_an_earlier_run_the_pose_is_honest_and_better_than_without():
    nees, squares = {True: [], False: []}, {True: [], False: []}
    for seed in range(12):
        corridor = Corridor(seed)
        known = corridor.mapped()
        frame = corridor.frame_of(known)
        for is_correlated in (True, False):
            corridor.rng = np.random.default_rng(1000 + seed)
            estimator = Estimator(corridor.settings(localization_mode='uncertain'))
            joint = known.joint_covariance if is_correlated else None
            estimator.load_map(replace(known, joint_covariance=joint))
            for time_s in corridor.drive(estimator, 100.0):
                if not estimator.is_localised or round(time_s / STEP_S) % 10:
                    continue
                pose = frame @ se3.exp(np.array([0.0, 0.0, 0.0, time_s * SPEED_M_S, 0.0, 0.0]))
                turn = estimator.pose[:3, :3] @ pose[:3, :3].T
                heading = np.arctan2(turn[1, 0], turn[0, 0])
                error = np.append(heading, (estimator.pose - pose)[:2, 3])
                P = estimator.pose_covariance[2:5, 2:5]
                nees[is_correlated].append(error @ np.linalg.solve(P, error) / 3)
                squares[is_correlated].append(error[1:] @ error[1:])
    assert np.mean(nees[True]) == pytest.approx(1.0, abs=0.35)
    assert np.mean(nees[False]) > 1.5 * np.mean(nees[True])
    assert np.mean(squares[True]) < np.mean(squares[False])


def packed(values):
    return base64.b64encode(zlib.compress(values.astype('<f8').tobytes())).decode()
