"""Maps of other programs become maps of this one, or are refused with the reason."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.geometry import so3
from slam_observer_ros.known_map.map_file import read_map, write_map
from slam_observer_ros.known_map.map_import import import_map

TAGSLAM = """
bodies:
 - lab:
     is_static: true
     pose:
       position: {x: 1.0, y: 0.0, z: 0.0}
       rotation: {x: 0.0, y: 0.0, z: 1.5707963267948966}
     tags:
     - id: 3
       size: 0.2
       pose:
         position: {x: 2.0, y: 0, z: 0.5}
         rotation: {x: 0.3, y: 0.0, z: 0.0}
     - {id: 4, size: 0.2}
 - rig:
     is_static: false
     tags:
     - {id: 9, size: 0.1, pose: {position: {x: 0, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}}
"""
BUNDLE = """
standalone_tags: []
tag_bundles:
  [ { name: 'door', layout: [
        {id: 10, size: 0.05, x: 0.5, y: -0.5, z: 0.0, qw: 0.8, qx: 0.6, qy: 0.0, qz: 0.0},
        {id: 11, size: 0.05, x: 1.5, y: 0.5 } ] } ]
"""


@pytest.fixture
def load(tmp_path):
    """Return a function that imports a text as a file of a name."""

    def read(text, name, tag_axes='right-up-out'):
        path = tmp_path / name
        path.write_text(text)
        return import_map(path, 'map', 0.02, 0.03, tag_axes)

    return read


def test_a_table_with_names(load):
    found = load('# tags of the hall\nID, x ,y,sigma,z\n7,1.5,-2,0.1,0.3\n8,9,1,,\n', 'tags.csv')
    assert found.ids.tolist() == [7, 8]
    assert_allclose(found.world_points, [[1.5, -2.0, 0.3], [9.0, 1.0, 0.0]])
    assert_allclose(found.covariances[:, 0, 0], [0.01, 0.0004])
    assert found.frame_id == 'map'


def test_a_table_without_names(load):
    found = load('7,1.5,-2\n8,9,1,0.5,0.1\n', 'tags.csv')
    assert_allclose(found.world_points, [[1.5, -2.0, 0.0], [9.0, 1.0, 0.5]])
    assert_allclose(found.covariances[0], np.diag([0.0004, 0.0004, 100.0]))  # height not known
    assert_allclose(found.covariances[1], 0.01 * np.eye(3))


def test_a_table_that_excel_has_saved(load):
    assert load('\ufeffid,x,y\r\n7,1.5,-2\r\n', 'tags.csv').ids.tolist() == [7]


def test_quaternions_of_a_table_and_points_among_them(load):
    names = 'id,x,y,z,qx,qy,qz,qw,orientation_sigma'
    found = load(f'{names}\n7,1,2,3,0,0,0.6,0.8,0.1\n8,4,5,6\n9,1,1,1,1,0,0,0\n', 'tags.csv')
    assert found.tags.tolist() == [0, 2]
    assert_allclose(found.orientations[0], so3.from_quaternion(np.array([0.0, 0.0, 0.6, 0.8])))
    assert_allclose(found.orientation_sigmas, [0.1, 0.0, 0.03])
    assert load('7,1,2\n', 'tags.csv').orientations is None


def test_an_upright_tag_looks_in_the_direction_of_its_yaw(load):
    found = load('id,x,y,yaw\n7,5,0,3.141592653589793\n8,0,5,\n', 'tags.csv')
    right, up, out = [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]  # on a wall ahead
    assert_allclose(found.orientations[0].T, [right, up, out], atol=1e-12)
    assert found.tags.tolist() == [0]


@pytest.mark.parametrize(
    ('tag_axes', 'columns'),
    [
        ('right-down-in', [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
        ('left-down-out', [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
    ],
)
def test_orientations_are_from_the_axes_that_a_detector_reports(load, tag_axes, columns):
    found = load('id,x,y,yaw\n7,5,0,3.141592653589793\n', 'tags.csv', tag_axes)
    assert_allclose(found.orientations[0].T, columns, atol=1e-12)


def test_orientations_may_be_left_out(load):
    found = load(BUNDLE, 'tags.yaml', 'none')
    assert found.orientations is None
    assert found.orientation_sigmas is None


@pytest.mark.parametrize('text', [TAGSLAM, TAGSLAM.replace('bodies:', '')])
def test_tags_of_tagslam_that_stand_still(load, text):
    found = load(text, 'tagslam.yaml')
    assert found.ids.tolist() == [3]
    assert_allclose(found.world_points, [[1.0, 2.0, 0.5]], atol=1e-9)
    body, tag = np.array([0.0, 0.0, np.pi / 2.0]), np.array([0.3, 0.0, 0.0])
    expected = so3.exp(body) @ so3.exp(tag)
    assert_allclose(found.orientations, [expected], atol=1e-12)
    assert_allclose(found.orientation_sigmas, [0.03])


def test_a_bundle_of_apriltags(load):
    found = load(BUNDLE, 'tags.yaml')
    assert found.ids.tolist() == [10, 11]
    assert_allclose(found.world_points, [[0.5, -0.5, 0.0], [1.5, 0.5, 0.0]])
    turned = so3.from_quaternion(np.array([0.6, 0.0, 0.0, 0.8]))
    assert_allclose(found.orientations, [turned, np.eye(3)])


def test_what_was_imported_can_be_saved_and_loaded(load, tmp_path):
    write_map(tmp_path / 'map.yaml', load('7,1,2,3\n', 'tags.csv'), None)
    found = read_map(tmp_path / 'map.yaml')
    assert found.ids.tolist() == [7]
    assert 'settings' not in (tmp_path / 'map.yaml').read_text()


@pytest.mark.parametrize(
    ('text', 'name', 'reason'),
    [
        ('', 'tags.csv', 'there are no landmarks in it'),
        ('id,y\n7,1\n', 'tags.csv', "there is no column 'x'; it needs id, x and y"),
        ('id;x;y\n7;1;2\n', 'tags.csv', 'it needs id, x and y, with commas'),
        ('7 1 2\n', 'tags.csv', 'there is no column|line 1: it needs id, x and y, with commas'),
        ('id,x,y\n7,1,two\n', 'tags.csv', "line 2: y is 'two', which is not a finite number"),
        ('7.5,1,2\n', 'tags.csv', "line 1: the id '7.5' is no whole number"),
        ('7,1,2\n7,1,2\n', 'tags.csv', 'landmark 7 is there more than once'),
        ('-7,1,2\n', 'tags.csv', 'the id -7 is not one from 0 to'),
        ('7,1,nan\n', 'tags.csv', 'not a finite number'),
        ('7,1,2,3,-0.1\n', 'tags.csv', 'sigma is negative'),
        ('format: other\n', 'tags.yaml', 'it is not laid out as TagSLAM'),
        (TAGSLAM.replace('rotation', 'turn'), 'tags.yaml', "body 'lab': 'rotation' is missing"),
        (TAGSLAM.replace('n: {x: 0.3', ': {x: 0.3'), 'tags.yaml', "tag 3: 'rotation' is missing"),
        (
            TAGSLAM.replace('x: 2.0', 'x: two'),
            'tags.yaml',
            "tag 3: position x is 'two', which",
        ),
        (TAGSLAM.replace('id: 3', 'id: three'), 'tags.yaml', "the id 'three' is not one"),
        ('bodies: [{a: {}, b: {}}]', 'tags.yaml', "each body is an entry .*: 'a', 'b'"),
        ('7,1,1e300\n', 'tags.csv', "line 1: y is '1e300', which is not a finite number"),
        ('bodies: [1, 2]\n', 'tags.yaml', 'it is not laid out as TagSLAM'),
        (
            BUNDLE.replace('y: -0.5', 'y: .nan'),
            'tags.yaml',
            'tag 10: y is nan, which is not a finite',
        ),
        (
            BUNDLE.replace('qw: 0.8', 'qw: 0.3'),
            'tags.yaml',
            'tag 10: the quaternion has norm',
        ),
        (BUNDLE.replace('id: 11, ', ''), 'tags.yaml', "'id' is missing"),
        ('tag_bundles: [{layout: []}, {layout: []}]', 'tags.yaml', 'it has 2 bundles, each in a'),
        ('7,1,2,3,0,0,0,1\n', 'tags.csv', 'line 1: it has more values than columns'),
        (
            'id,x,y,qx,qy,qz\n7,1,2,0,0,1\n',
            'tags.csv',
            'line 2: a quaternion needs qx, qy, qz',
        ),
        ('id,x,y,qx,qy,qz,qw\n7,1,2,0,0,0,0\n', 'tags.csv', 'line 2: the quaternion has norm 0,'),
        ('id,x,y,yaw,qw\n7,1,2,1,1\n', 'tags.csv', 'line 2: it has a yaw and a quaternion'),
        ('id,x,y,yaw\n7,1,2,90\n', 'tags.csv', 'line 2: yaw is 90, .* must be in radians'),
        (
            'id,x,y,yaw,orientation_sigma\n7,1,2,1,-1\n',
            'tags.csv',
            'sigma is negative',
        ),
        ('bodies: {a: [}\n', 'tags.yaml', 'is not valid'),
        ('tag_bundles: 3\n', 'tags.yaml', 'it is not laid out as TagSLAM'),
        ('\x00', 'tags.csv', 'tags.csv'),
    ],
)
def test_what_can_not_be_read_is_refused_with_the_reason(load, text, name, reason):
    with pytest.raises(MapError, match=reason):
        load(text, name)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MapError, match=r"can't read .*none\.csv"):
        import_map(tmp_path / 'none.csv', 'map', 0.02, 0.03)
