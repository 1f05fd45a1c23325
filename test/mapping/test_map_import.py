"""Maps of other programs become maps of this one, or are refused with the reason."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
import pytest

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.lie import so3
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.mapping.map_import import import_map

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


TABLE = 'id,x,y,z\n1,1.5,2.0,0.3\n2,3.25,4.5,0.3\n'


@pytest.mark.parametrize(
    'content',
    [
        TABLE,
        TABLE.replace(',', ';'),
        'id;x;y;z\n1;1,5;2,0;0,3\n2;3,25;4,5;0,3\n',
        'id\tx\ty\tz\n1\t1,5\t2,0\t0,3\n2\t3,25\t4,5\t0,3\n',
        TABLE.replace(',', '\t'),
        TABLE.replace(',', ' '),
        TABLE.replace(',', '   ').replace('\n', '  \r\n'),
        'id x y z\n1 1,5 2,0 0,3\n2 3,25 4,5 0,3\n',
        TABLE.replace(',', ', '),
        '1 1.5 2.0 0.3\n2 3.25 4.5 0.3\n',
        '# id x y z\n1 1.5 2.0 0.3\n2 3.25 4.5 0.3\n',
        '#z,id,x,y\n0.3,1,1.5,2.0\n0.3,2,3.25,4.5\n',
        'sep=;\n' + TABLE.replace(',', ';'),
        TABLE + ',,,\n\n,,,\n',
        'Tag_ID,X [m],Y(m),z\n1.0,1.5,2.0,0.3\n2.0,3.25,4.5,0.3\n',
        'marker,x_m,pos_y,z_cm\n1,1.5,2.0,30\n2,3.25,4.5,30\n',
        'id,x [mm],y [cm],z\n1,1500,200,0.3\n2,3250,450,0.3\n',
        '"id","x","y","z"\n"1","1,5","2,0","0,3"\n"2","3,25","4,5","0,3"\n',
        TABLE.encode('utf-16'),
        TABLE.encode('utf-8-sig'),
    ],
)
def test_tables_are_read_however_they_are_separated_and_encoded(tmp_path, content):
    path = tmp_path / 'tags.csv'
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    found = import_map(path, 'map', 0.02, 0.03)
    assert found.ids.tolist() == [1, 2]
    assert_allclose(found.world_points, [[1.5, 2.0, 0.3], [3.25, 4.5, 0.3]])


def test_columns_of_words_are_left_out_by_name(tmp_path, caplog):
    path = tmp_path / 'tags.csv'
    path.write_bytes('id,x,y,Ort,size\n1,1.5,2.0,Tür,0.1\n'.encode('latin-1'))
    assert import_map(path, 'map', 0.02, 0.03).ids.tolist() == [1]
    assert "left out: column 'ort', column 'size'" in caplog.text


def test_deviations_of_each_axis_and_angles_in_degrees_are_used(load):
    names = 'id,x,y,z,sigma,sigma_x,sigma_z,roll,yaw [deg],orientation_sigma [deg]'
    found = load(f'{names}\n1,1,2,3,0.1,0.2,,0,90,2\n', 'tags.csv')
    assert_allclose(found.covariances[0], np.diag([0.04, 0.01, 0.01]))
    assert_allclose(found.orientations[0][:, 2], [0.0, 1.0, 0.0], atol=1e-12)
    assert_allclose(found.orientation_sigmas, np.radians([2.0]))


def test_a_map_of_fiducial_slam(load):
    text = '7 1.0 2.0 0.5 0 0 0 0 0\n8 1 2 3 90.0 0.0 0.0 0.04 12 7\n'
    found = load(text, 'map.txt')
    assert found.ids.tolist() == [7, 8]
    turned = so3.exp(np.array([np.pi / 2.0, 0.0, 0.0]))
    assert_allclose(found.orientations, [np.eye(3), turned], atol=1e-12)
    assert_allclose(found.covariances[:, 0, 0], [0.02**2, 0.04])


FIELD = """{
\t"tags": [
\t\t{"ID": 3, "pose": {"translation": {"x": 16.5, "y": 4.0, "z": 0.5},
\t\t\t"rotation": {"quaternion": {"W": 0.0, "X": 0.0, "Y": 0.0, "Z": 1.0}}}}],
\t"field": {"length": 16.54, "width": 8.21}
}"""


def test_a_field_of_frc_whose_tags_look_along_their_x_axis(load):
    found = load(FIELD, 'field.json')
    assert found.ids.tolist() == [3]
    assert_allclose(found.world_points, [[16.5, 4.0, 0.5]])
    right, up, out = [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]
    assert_allclose(found.orientations[0].T, [right, up, out], atol=1e-12)


NOISE = """
body_defaults: {position_noise: 0.05, rotation_noise: 0.01}
bodies:
 - wall:
     is_static: true
     pose:
       position: {x: 1.0, y: 0.0, z: 0.0}
       rotation: {x: 0.0, y: 0.0, z: 1.5707963267948966}
       position_noise: {x: 0.0, y: 0.0, z: 0.3}
       rotation_noise: {x: 0.0, y: 0.0, z: 0.02}
     tags:
     - id: 3
       pose:
         position: {x: 5.0, y: 0, z: 0.0}
         rotation: {x: 0.0, y: 0.0, z: 0.0}
         position_noise: {x: 0.1, y: 0.2, z: 0.0}
         rotation_noise: {x: 0.0, y: 0.0, z: 0.0}
     - {id: 4, pose: {position: {x: 0, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}}
     - {id: 5, size: 0.1}
 - shelf:
     is_static: true
     tags:
     - {id: 6, pose: {position: {x: 0, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}}
 - rig: {is_static: false, tags: [{id: 9}]}
 - board:
     is_static: true
     type: board
     pose: {position: {x: 0, y: 0, z: 2}, rotation: {x: 0, y: 0, z: 0}}
     board: {tag_start_id: 20, tag_size: 0.4, tag_spacing: 0.25, tag_rows: 2, tag_columns: 3}
"""


def test_noise_that_tagslam_states_is_used_and_what_has_no_place_is_named(load, caplog):
    found = load(NOISE, 'tagslam.yaml')
    assert found.ids.tolist() == [3, 4, *range(20, 26)]
    of_turn_m2 = (5.0 * 0.02) ** 2  # the tag is 5 m ahead of the body that may be turned
    expected = np.diag([0.2**2 + of_turn_m2, 0.1**2, 0.3**2])
    assert_allclose(found.covariances[0], expected, atol=1e-12)
    assert_allclose(found.orientation_sigmas[0], 0.02 / 3.0**0.5)
    assert_allclose(
        found.covariances[1], np.diag([0.05**2, 0.05**2, 0.05**2 + 0.3**2]), atol=1e-12
    )
    assert_allclose(found.world_points[-1], [1.0, 0.5, 2.0])
    for named in ('tag 5, which has no', "body 'shelf', which has no", "body 'rig', which moves"):
        assert named in caplog.text


ROS2_BUNDLE = """
tag_bundles:
  bundle_names: [wall]
  wall:
    ids: [0, 1]
    0: {size: 0.1, transform: [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]}
    1: {size: 0.1, transform: [0.5, 0.0, 0.0, 0.8, 0.6, 0.0, 0.0]}
"""


def test_a_bundle_of_ros_2(load):
    found = load(ROS2_BUNDLE, 'tags.yaml')
    assert found.ids.tolist() == [0, 1]
    assert_allclose(found.world_points, [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    assert_allclose(found.orientations[1], so3.from_quaternion(np.array([0.6, 0.0, 0.0, 0.8])))


def test_many_landmarks_take_no_longer_each(load):
    """How often each id is there was counted for each of them: a minute for these."""
    count = 60_000
    assert (
        len(load('id,x,y\n' + ''.join(f'{i},1,2\n' for i in range(count)), 'a.csv').ids) == count
    )


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
        ('7\n', 'tags.csv', 'line 1: it needs id, x and y'),
        (
            'id,x,y,z,roll,pitch,yaw\n1,1,2,0,0,0.5,1\n',
            'tags.csv',
            "line 2: column 'pitch' is 0.5, and is not known here .a tag that is not upright",
        ),
        ('id,x,y,weight\n1,1,2,\n2,3,4,7\n', 'tags.csv', "line 3: column 'weight' is 7"),
        ('id,x,y,x\n1,1,2,3\n', 'tags.csv', "column 'x' is there twice"),
        ('id,x [ft],y\n1,1,2\n', 'tags.csv', "column 'x .ft.' is of a unit that is not known"),
        ('1 1 2 3 0 0 0 0.1 5\n2 1 2 3\n', 'map.txt', 'line 2: it is not laid out as the others'),
        ('1 1 2 3 0 0 0 -0.1 5\n', 'map.txt', 'line 1: the variance is negative'),
        ('{"field": {}}', 'f.json', "it is no AprilTag field layout of FRC, which has 'tags'"),
        (
            '{"tags": [{"ID": 1, "pose": {"translation": {"x": 1, "y": 2}}}]}',
            'f.json',
            "tag 1: 'z' is missing",
        ),
        ('[', 'f.json', 'f.json: Expecting value'),
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
        ('id,x,y,z\n7,1,2,3\n8,1,2\n', 'tags.csv', 'line 3: it has fewer values than columns'),
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


SCANNER = """# globID x/mm y/mm type subtype size/mm layerID
1 5300 -2300 1 2 90 1
2\t-5100\t6600\t1\t2\t90\t1

7 2300 -10200 1 2 90 1
"""


@pytest.mark.parametrize('suffix', ['imk', 'lmk', 'LMK'])
def test_the_landmark_file_of_a_navigation_scanner_is_in_millimetres(load, suffix):
    found = load(SCANNER, f'layout.{suffix}')
    assert found.ids.tolist() == [1, 2, 7]
    assert_allclose(found.world_points[:, :2], [[5.3, -2.3], [-5.1, 6.6], [2.3, -10.2]])
    assert_allclose(np.sqrt(np.diagonal(found.covariances[0])), [0.02, 0.02, 10.0])


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('1 5300\n', 'line 1: it is not laid out as: globID'),
        ('1 5300 north 1\n', 'line 1: it is not laid out as: globID'),
        ('1.5 5300 2 1\n', "line 1: the id '1.5' is no whole number"),
        ('1 nan 2 1\n', 'line 1: x is'),
        ('1 2 3\n1 3 4\n', 'more than once|twice'),
    ],
)
def test_a_scanners_file_that_is_none_is_refused(load, text, reason):
    with pytest.raises(MapError, match=reason):
        load(text, 'layout.imk')


def test_a_survey_that_looks_like_millimetres_is_asked_about(tmp_path):
    path = tmp_path / 'hall.csv'
    path.write_text('id,x,y,z,sigma\n1,5300,-2300,0,20\n2,-5100,6600,0,20\n3,2300,-10200,0,20\n')
    with pytest.raises(MapError, match=r'16\.8 km apart: are these millimetres\? Give --unit mm'):
        import_map(path, 'map', 0.02, 0.03)
    found = import_map(path, 'map', 0.02, 0.03, unit='mm')
    assert_allclose(found.world_points[0], [5.3, -2.3, 0.0])
    assert_allclose(np.diagonal(found.covariances[0]), 0.02**2)
    assert import_map(path, 'map', 0.02, 0.03, unit='m').world_points[0, 0] == 5300.0


def test_a_large_site_whose_landmarks_are_close_to_each_other_is_in_metres(tmp_path):
    path = tmp_path / 'site.csv'
    rows = [f'{i},{40.0 * i},{7.0 * (i % 3)}' for i in range(60)]
    path.write_text('\n'.join(['id,x,y', *rows]))
    assert len(import_map(path, 'map', 0.02, 0.03).ids) == 60
