"""Map files: what is written is read back, and what can't be right is refused with a reason."""

from __future__ import annotations

from dataclasses import replace
import os
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_array_equal
import pytest
import yaml

from slam_observer_ros import __version__
from slam_observer_ros.common.errors import MapError, SlamObserverError
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import check_writable, read_map, read_maps, write_map
from slam_observer_ros.settings.estimator_settings import Settings

SURVEYED = """\
format: slam_observer_ros map
version: 1
frame: hall
landmarks:
- {id: 7, position: [1.5, -2, 0.3], sigma: 0.01}
- {id: 3, position: [0, 0, 1.0e-3], sigma: 0.02}
"""


def a_map(n=5, seed=0):
    noise = np.random.default_rng(seed)
    roots = noise.normal(scale=0.1, size=(n, 3, 3))
    return LandmarkMap(
        noise.choice(MAX_ID + 1, n, replace=False),
        noise.normal(scale=1e3, size=(n, 3)),
        roots @ roots.swapaxes(1, 2),
        noise.integers(0, 10**6, n),
        'hall',
    )


def assert_same_map(one, other):
    assert_array_equal(one.ids, other.ids)
    assert_array_equal(one.world_points, other.world_points)
    assert_array_equal(one.counts, other.counts)
    assert one.frame_id == other.frame_id
    if one.covariances is None:
        assert other.covariances is None
    else:
        assert_array_equal(one.covariances, other.covariances)


@given(st.integers(1, 20), st.integers(0, 1000))
def test_a_map_is_read_back_bit_for_bit(tmp_path_factory, n, seed):
    path = tmp_path_factory.mktemp('map') / 'map.yaml'
    write_map(path, a_map(n, seed), Settings())
    assert_same_map(read_map(path), a_map(n, seed))


def test_an_empty_map_replaces_none(tmp_path):
    path = tmp_path / 'map.yaml'
    write_map(path, a_map(3), Settings())
    with pytest.raises(MapError, match='the map is empty: nothing is written to'):
        write_map(path, a_map(0), Settings())
    assert_same_map(read_map(path), a_map(3))


def test_a_map_without_covariances_is_read_back_without(tmp_path):
    path, bare = tmp_path / 'map.yaml', a_map()
    bare = LandmarkMap(bare.ids, bare.world_points, None, bare.counts)
    write_map(path, bare, Settings())
    assert_same_map(read_map(path), bare)


def test_a_file_says_what_it_was_made_with_and_has_a_line_a_landmark(tmp_path):
    path = tmp_path / 'map.yaml'
    write_map(path, a_map(9), Settings(gains='constant'))
    content = yaml.safe_load(path.read_text())
    assert content['package_version'] == __version__
    assert content['settings']['gains'] == 'constant'
    assert sum(line.startswith('- {id: ') for line in path.read_text().splitlines()) == 9


def test_a_surveyor_needs_no_more_than_ids_positions_and_sigma(tmp_path):
    path = tmp_path / 'surveyed.yaml'
    path.write_text(SURVEYED)
    surveyed = read_map(path)
    assert surveyed.frame_id == 'hall'
    assert_array_equal(surveyed.ids, [7, 3])
    assert_array_equal(surveyed.world_points, [[1.5, -2.0, 0.3], [0.0, 0.0, 1e-3]])
    assert_array_equal(surveyed.covariances[1], 0.02**2 * np.eye(3))
    assert_array_equal(surveyed.counts, [0, 0])


def test_a_surveyed_landmark_may_be_exact_and_have_the_largest_id(tmp_path):
    path = tmp_path / 'surveyed.yaml'
    path.write_text(SURVEYED.replace('id: 3', f'id: {MAX_ID}').replace('0.02', '0'))
    surveyed = read_map(path)
    assert surveyed.ids[1] == MAX_ID
    assert not surveyed.covariances[1].any()


@pytest.mark.parametrize(
    'rows',
    [
        '[[1, 0.5, 0], [0.5000001, 1, 0], [0, 0, 1]]',
        '[[1, 1.0000001, 0], [1.0000001, 1, 0], [0, 0, 1]]',
    ],
)
def test_a_covariance_with_the_digits_that_somebody_writes_down_is_read(tmp_path, rows):
    path = tmp_path / 'surveyed.yaml'
    path.write_text(SURVEYED.replace('sigma: 0.01', f'covariance: {rows}'))
    np.testing.assert_allclose(read_map(path).covariances[0], yaml.safe_load(rows))


def test_an_older_map_is_replaced_at_once_and_nothing_else_is_left(tmp_path):
    path = tmp_path / 'map.yaml'
    write_map(path, a_map(3), Settings())
    write_map(path, a_map(4), Settings())
    assert len(read_map(path).ids) == 4
    assert [file.name for file in tmp_path.iterdir()] == ['map.yaml']


def test_a_map_that_cannot_be_written_leaves_the_older_one_alone(tmp_path, monkeypatch):
    path = tmp_path / 'map.yaml'
    write_map(path, a_map(3), Settings())

    def full_disk(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('slam_observer_ros.common.files.os.fsync', full_disk)
    with pytest.raises(MapError, match=r"can't write map .*map\.yaml: No space left"):
        write_map(path, a_map(4), Settings())
    assert len(read_map(path).ids) == 3
    assert [file.name for file in tmp_path.iterdir()] == ['map.yaml']


def test_a_map_is_written_where_a_link_leads_and_never_over_a_pipe(tmp_path):
    (tmp_path / 'link.yaml').symlink_to('map.yaml')
    write_map(tmp_path / 'link.yaml', a_map(4), Settings())
    assert (tmp_path / 'link.yaml').is_symlink()
    assert len(read_map(tmp_path / 'map.yaml').ids) == 4
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(MapError, match=r"can't write map .*pipe: it is there, and no regular"):
        write_map(tmp_path / 'pipe', a_map(4), Settings())
    assert (tmp_path / 'pipe').is_fifo()
    assert len(list(tmp_path.iterdir())) == 3


def test_whether_a_map_can_be_written_is_checked_where_it_would_be_written(tmp_path):
    (tmp_path / 'elsewhere').mkdir()
    (tmp_path / 'link.yaml').symlink_to('elsewhere/map.yaml')
    check_writable(tmp_path / 'link.yaml')
    (tmp_path / 'elsewhere').rmdir()
    reason = f'the directory {tmp_path / "elsewhere"} takes no file: No such file'
    with pytest.raises(MapError, match=rf"can't write map .*link\.yaml: {reason}"):
        check_writable(tmp_path / 'link.yaml')
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(MapError, match=r"can't write map .*pipe: it is there, and no regular"):
        check_writable(tmp_path / 'pipe')
    (tmp_path / 'itself').symlink_to('itself')
    with pytest.raises(MapError, match=r"can't write map .*itself: it is there, and no regular"):
        check_writable(tmp_path / 'itself')
    with pytest.raises(MapError, match=r"can't write map .*: it is a directory"):
        check_writable(tmp_path)
    assert len(list(tmp_path.iterdir())) == 3


def test_a_folder_that_is_missing_is_named(tmp_path):
    path = tmp_path / 'no' / 'map.yaml'
    with pytest.raises(MapError, match=f"can't write map {path}: No such file or directory"):
        write_map(path, a_map(), Settings())
    with pytest.raises(MapError, match=f"can't read map {path}: No such file or directory"):
        read_map(path)


def test_a_folder_has_the_maps_of_several_halls(tmp_path):
    for name, count in (('hall_b.yaml', 4), ('hall_a.yml', 3)):
        write_map(tmp_path / name, a_map(count), Settings())
    (tmp_path / 'notes.txt').write_text('no map')
    maps = read_maps(tmp_path)
    assert [(known.name, len(known.ids)) for known in maps] == [('hall_a', 3), ('hall_b', 4)]
    assert [known.name for known in read_maps(tmp_path / 'hall_b.yaml')] == ['hall_b']
    (tmp_path / 'empty').mkdir()
    with pytest.raises(MapError, match=r'there is no map, a file \*\.yaml, in the folder .*empty'):
        read_maps(tmp_path / 'empty')


NO_MAPS = {
    'grid': ('image: hall.pgm\nresolution: 0.05\n', 'it is an occupancy grid'),
    'params': ('observer_node:\n  ros__parameters:\n    two_d_mode: true\n', 'it has no line'),
    'camera': ('%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 3\n', 'is not valid YAML'),
    'empty': ('', 'it has no line'),
    '._hall': ('\x00\x05\x16\x07', 'is not valid YAML'),
}


@pytest.mark.parametrize('name', NO_MAPS)
def test_a_file_of_a_folder_that_is_no_map_is_skipped_and_named(name, tmp_path, caplog):
    content, why = NO_MAPS[name]
    (tmp_path / f'{name}.yaml').write_text(content)
    with pytest.raises(MapError, match='there is no map of landmarks in the folder'):
        read_maps(tmp_path)
    with pytest.raises(MapError, match=why):
        read_maps(tmp_path / f'{name}.yaml')
    caplog.clear()
    write_map(tmp_path / 'hall.yaml', a_map(), Settings())
    assert [known.name for known in read_maps(tmp_path)] == ['hall']
    why = f'it {why.removeprefix("it ")}'
    assert f'{name}.yaml of the folder of maps is skipped, as {why}' in ' '.join(caplog.messages)


@pytest.mark.parametrize(
    ('old', 'new'), [('position', 'possition'), ('version: 1', 'version: 7'), ('[', '{[')]
)
def test_a_map_of_a_folder_that_is_wrong_is_not_skipped(old, new, tmp_path):
    write_map(tmp_path / 'a.yaml', a_map(), Settings())
    (tmp_path / 'b.yaml').write_text(changed(old, new))
    with pytest.raises(MapError, match=r'map .*b\.yaml'):
        read_maps(tmp_path)


def test_of_maps_that_say_the_same_one_is_taken_and_it_is_said_once(tmp_path, caplog):
    known = replace(a_map(5), covariances=np.tile(1e-4 * np.eye(3), (5, 1, 1)))
    write_map(tmp_path / 'hall.yaml', known, Settings())
    (tmp_path / 'hall_copy.yaml').write_bytes((tmp_path / 'hall.yaml').read_bytes())
    write_map(tmp_path / 'hall.yml', known.select(np.arange(5)[::-1]), None)  # in another order
    later = replace(known, world_points=known.world_points + 0.01)
    write_map(tmp_path / 'hall_later.yaml', later, Settings())
    moved = replace(known, world_points=known.world_points + [3.0, 0.0, 0.0])
    write_map(tmp_path / 'other.yaml', moved, Settings())
    assert [each.name for each in read_maps(tmp_path)] == ['hall.yaml', 'other']
    said = [text for text in caplog.messages if 'say the same' in text]
    assert len(said) == 3
    R = np.tile(np.eye(3), (5, 1, 1))
    tags = replace(known, orientations=R, orientation_sigmas=np.ones(5))
    assert tags.says_the_same(replace(tags, orientations=tags.orientations[::-1]))
    assert not tags.says_the_same(known)
    turned = replace(tags, orientations=-tags.orientations[:, ::-1])
    exact = {'orientation_sigmas': np.full(5, 0.02)}
    assert not replace(tags, **exact).says_the_same(replace(turned, **exact))
    assert 'The maps hall.yaml and hall_copy say the same, so hall.yaml is used' in said[1]


def changed(old, new):
    assert old in SURVEYED
    return SURVEYED.replace(old, new)


BAD_FILES = [
    ('', "no line 'format: slam_observer_ros map'"),
    ('just text', "no line 'format.*; slam-observer map convert makes maps"),
    ('image: hall.pgm\nresolution: 0.05\norigin: [0, 0, 0]', 'it is an occupancy grid'),
    ('[1, 2]', "no line 'format"),
    (SURVEYED[:-10], 'not valid YAML'),
    ('a: ]', 'not valid YAML'),
    ('[' * 5000, 'not valid YAML'),
    (changed('slam_observer_ros map', 'slam_toolbox map'), "no line 'format"),
    (changed('version: 1', 'version: 2'), 'version 2; this program reads 1'),
    (changed('version: 1\n', ''), 'version None'),
    (changed('frame: hall\n', ''), "has no 'frame'"),
    (changed('frame: hall', 'frame: 3'), "'frame' is 3, not a name"),
    (changed('frame: hall', "frame: ''"), "'frame' is '', not a name"),
    (changed('frame: hall', 'frame: hall\nframes: 1'), "has 'frames', which is not known"),
    ('\n'.join(SURVEYED.splitlines()[:3]), "has no 'landmarks'"),
    ('\n'.join(SURVEYED.splitlines()[:4]), "'landmarks' is not a list"),
    (SURVEYED[: SURVEYED.index('landmarks:')] + 'landmarks: []', 'it has no landmarks'),
    (changed('{id: 7, position: [1.5, -2, 0.3], sigma: 0.01}', '7'), 'entry 0 of landmarks'),
    (changed('id: 7, ', ''), "entry 0 of landmarks has no 'id'"),
    (changed('id: 7', 'id: -7'), "entry 0 of landmarks: 'id' is -7"),
    (changed('id: 7', 'id: seven'), "'id' is 'seven'"),
    (changed('id: 7', 'id: true'), "'id' is True"),
    (changed('id: 7', f'id: {2**63}'), f"'id' is {2**63}"),
    (changed('id: 7', 'id: 4294967295'), "'id' is 4294967295, beyond 4294967294"),
    (changed('id: 7', 'id: 3'), 'landmark 3 is there 2 times'),
    (changed('position: [1.5, -2, 0.3], ', ''), "has no 'position'"),
    (changed('[1.5, -2, 0.3]', '[1.5, -2]'), "landmark 7: 'position' is .* 3 numbers"),
    (changed('[1.5, -2, 0.3]', '3'), "landmark 7: 'position' is 3"),
    (changed('-2', '.nan'), "landmark 7: 'position' has nan"),
    (changed('-2', '.inf'), "landmark 7: 'position' has inf"),
    (changed('-2', '1' + 400 * '0'), "landmark 7: 'position' has 1000"),
    (changed('-2', 'x'), "landmark 7: 'position' has 'x'"),
    (changed('-2', 'true'), "landmark 7: 'position' has True"),
    (changed('sigma: 0.01', 'sigma: -1'), "landmark 7: 'sigma' is negative"),
    (changed('sigma: 0.01', 'sigma: .nan'), "landmark 7: 'sigma' has nan"),
    (changed('id: 7', 'id: 010'), "entry 0 of landmarks: 'id' is '010'"),
    (changed('1.5', '{{ x }}'), 'not valid YAML'),
    (changed('id: 7', 'id: 1:30'), "'id' is '1:30'"),
    (changed('sigma: 0.01', 'position: [0, 0, 0]'), "'position' is there 2 times in one entry"),
    (changed(', sigma: 0.01', ''), "landmark 7 has no 'sigma' or 'covariance', as others have"),
    (changed('sigma: 0.01', 'variance: 0.01'), "has 'variance', which is not known"),
    (changed('sigma: 0.01', 'sigma: 0.01, covariance: []'), "landmark 7 has both 'sigma' and"),
    (changed('sigma: 0.01', 'covariance: 3'), "landmark 7: 'covariance' is not 3 × 3"),
    (changed('sigma: 0.01', 'covariance: [[1, 0, 0], [0, 1], [0, 0, 1]]'), 'list of 3 numbers'),
    (changed('sigma: 0.01', 'covariance: [[1, 9, 0], [0, 1, 0], [0, 0, 1]]'), 'not symmetric'),
    (changed('sigma: 0.01', 'covariance: [[1, 9, 0], [9, 1, 0], [0, 0, 1]]'), 'negative in some'),
    (changed('sigma: 0.01', 'sigma: 0.01, observations: 1.5'), "'observations' is 1.5"),
]


@pytest.mark.parametrize('number', ['1.5', '+1.5', '15e-1', '0.15e1', '1.5E0', '15.e-1'])
def test_a_number_is_read_however_it_is_written(tmp_path, number):
    path = tmp_path / 'map.yaml'
    path.write_text(changed('[1.5, -2', f'[{number}, -.2e1'))
    np.testing.assert_array_equal(read_map(path).world_points[0, :2], [1.5, -2.0])


@pytest.mark.parametrize(('text', 'reason'), BAD_FILES)
def test_a_file_that_cannot_be_right_is_refused_with_its_name_and_the_reason(
    tmp_path, text, reason
):
    path = tmp_path / 'bad.yaml'
    path.write_text(text)
    with pytest.raises(MapError, match=reason) as caught:
        read_map(path)
    assert str(path) in str(caught.value)
    assert isinstance(caught.value, SlamObserverError)


@given(st.binary(max_size=300))
def test_no_file_makes_anything_but_a_map_error(tmp_path_factory, content):
    path = tmp_path_factory.mktemp('map') / 'fuzz.yaml'
    path.write_bytes(content)
    with pytest.raises(MapError):
        read_map(path)


@given(st.data())
def test_a_damaged_map_is_read_or_refused_but_nothing_else(tmp_path_factory, data):
    whole = bytearray(SURVEYED.encode())
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] = data.draw(st.integers(0, 255))
    path = Path(tmp_path_factory.mktemp('map')) / 'damaged.yaml'
    path.write_bytes(bytes(whole))
    try:
        read = read_map(path)
    except MapError as error:
        assert str(path) in str(error)
    else:
        assert np.isfinite(read.world_points).all()


@pytest.mark.parametrize(
    'rows',
    [
        '[[-1, 0, 0], [0, 1.0e12, 0], [0, 0, 1]]',
        '[[1, 2, 0], [2, 1, 0], [0, 0, 1.0e12]]',
        '[[1, 0.5, 0], [0.4, 1, 0], [0, 0, 1.0e12]]',
        '[[0, 1, 0], [1, 1.0e6, 0], [0, 0, 1]]',
        '[[1.0e-9, 1, 0], [1, 1.0e6, 0], [0, 0, 1]]',
    ],
)
def test_a_large_variance_hides_no_wrong_one_beside_it(tmp_path, rows):
    path = tmp_path / 'surveyed.yaml'
    path.write_text(SURVEYED.replace('sigma: 0.02', f'covariance: {rows}'))
    with pytest.raises(MapError, match="landmark 3: 'covariance' is not symmetric, or negative"):
        read_map(path)


@pytest.mark.parametrize('m2', [0.0, 1e-30, 1e-9, 1.0, 1e12])
def test_covariances_of_every_scale_are_read_with_the_rounding_of_a_filter(tmp_path, m2):
    path = tmp_path / 'map.yaml'
    scales = np.sqrt(np.array([m2, 1e-4, 1e4]))
    covariances = np.array([[1, 1, 0.5], [1, 1, 0.5], [0.5, 0.5, 1]]) * scales * scales[:, None]
    covariances[0, 0] -= 1e-16
    one = LandmarkMap(np.array([5]), np.zeros((1, 3)), covariances[None], np.array([1]))
    write_map(path, one, Settings())
    assert_same_map(read_map(path), one)
