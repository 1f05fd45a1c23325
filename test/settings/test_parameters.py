"""Parameter tables: defaults, types, ranges, YAML files, and errors that say what to do."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
import math
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest
import yaml

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import (
    InputSettings,
    ManagedNodeSettings,
    ObserverNodeSettings,
    SimulatorNodeSettings,
)
from slam_observer_ros.settings.parameter_file import (
    misplaced_sections,
    mixed_lists,
    read_parameter_file,
)
from slam_observer_ros.settings.parameter_table import from_parameters, parameter, table
from slam_observer_ros.simulation import Scenario

CONFIG_FOLDER = Path(__file__).resolve().parents[2] / 'config'
TABLES = [
    Settings,
    Scenario,
    ObserverNodeSettings,
    ManagedNodeSettings,
    SimulatorNodeSettings,
]


@dataclass(frozen=True)
class Example:
    """One parameter of each type."""

    flag: bool = parameter(False, 'A flag')
    count: int = parameter(3, 'A count', minimum=1, maximum=10)
    length: float = parameter(0.5, 'A length', unit='m', minimum=0.0)
    mode: str = parameter('slow', 'A mode', choices=('slow', 'fast'))
    name: str = parameter('map', 'A name')
    vector: tuple[float, float, float] = parameter((1.0, 2.0, 3.0), 'A vector', minimum=0.0)


def error_text(values, settings_class=Example):
    with pytest.raises(ParameterError) as error:
        from_parameters(settings_class, values)
    text = str(error.value)
    assert '\n' not in text
    return text


ROWS = [row for settings_class in TABLES for row in table(settings_class)]


def test_a_time_in_nanoseconds_is_refused_where_seconds_are_meant():
    for name in ('velocity_timeout', 'reorder_window', 'late_limit'):
        assert name in error_text({name: 1e10}, Settings)


@pytest.mark.parametrize('settings_class', TABLES)
def test_each_field_is_a_row_of_the_table_and_the_other_way_round(settings_class):
    rows = table(settings_class)
    assert [row.name for row in rows] == [field.name for field in fields(settings_class)]
    assert [row.default for row in rows] == [field.default for field in fields(settings_class)]
    values = {row.name: row.default for row in rows}
    assert from_parameters(settings_class, values) == settings_class()


def test_each_default_is_in_its_own_range_and_of_its_own_type():
    for row in ROWS:
        checked = row.check(row.default)
        assert checked == row.default, row.name
        assert type(checked) is type(row.default), row.name


def test_each_row_is_described_by_one_line_without_a_full_stop():
    for row in ROWS:
        assert row.description, row.name
        assert '\n' not in row.description
        assert row.description[0].isupper() or row.description.startswith('p')
        assert not row.description.endswith('.')
        assert row.name == row.name.lower()


def test_each_number_has_a_least_and_a_greatest_value_that_are_refused_when_exceeded():
    for row in ROWS:
        if isinstance(row.default, bool | str):
            continue
        assert math.isfinite(row.minimum), row.name
        assert math.isfinite(row.maximum), row.name
        for wrong in (2 * row.maximum + 1, row.minimum - 1):
            number = int(wrong) if isinstance(row.default, int) else wrong
            value = (number,) * len(row.default) if isinstance(row.default, tuple) else number
            with pytest.raises(ParameterError, match=f"'{row.name}' takes a value ≥ .*, ≤ "):
                row.check(value)


def test_no_name_stands_for_two_things_in_one_node():
    for node in ((Settings, ObserverNodeSettings), (Scenario, SimulatorNodeSettings)):
        names = [row.name for settings_class in node for row in table(settings_class)]
        assert len(names) == len(set(names))


def test_values_are_taken_and_missing_ones_keep_their_defaults():
    values = {'flag': True, 'count': 7, 'length': 2, 'mode': 'fast', 'vector': [0, 1.5, 2]}
    settings = from_parameters(Example, values)
    assert settings == Example(True, 7, 2.0, 'fast', 'map', (0.0, 1.5, 2.0))
    assert isinstance(settings.length, float)
    assert all(isinstance(entry, float) for entry in settings.vector)
    assert from_parameters(Example, {}) == Example()


@pytest.mark.parametrize(
    ('name', 'value', 'expected'),
    [
        ('flag', 1, 'true or false'),
        ('flag', 'true', 'true or false'),
        ('count', 2.0, 'an integer'),
        ('count', True, 'an integer'),
        ('count', '3', 'an integer'),
        ('count', 0, '≥ 1, ≤ 10'),
        ('count', 11, '≥ 1, ≤ 10'),
        ('length', -0.1, '≥ 0'),
        ('length', math.nan, 'finite'),
        ('length', math.inf, 'finite'),
        ('length', 'long', 'a number'),
        ('length', True, 'a number'),
        ('length', None, 'a number'),
        ('mode', 'medium', 'slow, fast'),
        ('mode', 3, 'a string'),
        ('name', ['map'], 'a string'),
        ('vector', [1.0, 2.0], 'a list of 3 numbers'),
        ('vector', 1.0, 'a list of 3 numbers'),
        ('vector', '1.0', 'a list of 3 numbers'),
        ('vector', 'abc', 'a list of 3 numbers'),
        ('vector', [1.0, 2.0, 'x'], 'a number'),
        ('vector', [1.0, 2.0, -1.0], '≥ 0'),
        ('vector', [1.0, 2.0, math.nan], 'finite'),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_name_value_and_what_fits(name, value, expected):
    text = error_text({name: value})
    assert f"'{name}'" in text
    assert expected in text
    entries = value if isinstance(value, list) else [value]
    assert any(repr(entry) in text for entry in [value, *entries])


@pytest.mark.parametrize(
    ('written', 'meant'),
    [('gain', 'gain'), ('Gains', 'gains'), ('two_d', 'two_d_mode'), ('range_nois', 'range_noise')],
)
def test_an_unknown_name_is_refused_with_the_one_that_may_be_meant(written, meant):
    text = error_text({written: 1.0}, Settings)
    assert f"unknown parameter '{written}'" in text
    assert f"did you mean '{meant}" in text


def test_where_no_name_is_near_none_is_suggested():
    assert error_text({'xyzzy': 1}, Settings) == "unknown parameter 'xyzzy'"


def test_what_a_robot_needs_first_is_about_a_dozen_of_each():
    for settings_class in (Settings, ObserverNodeSettings):
        assert 5 <= sum(row.basic for row in table(settings_class)) <= 12


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda children: st.lists(children, max_size=4) | st.dictionaries(st.text(), children),
    max_leaves=5,
)


def values_of(row):
    """Values that a row of the table takes, those at its limits among them."""
    if isinstance(row.default, bool):
        return st.booleans()
    if row.choices:
        return st.sampled_from(row.choices)
    if isinstance(row.default, str):
        return st.text('abc/_é', max_size=5)
    low, high = max(row.minimum, -1e6), min(row.maximum, 1e6)
    if isinstance(row.default, int):
        return st.integers(int(low), int(high))
    number = st.floats(low, high) | st.sampled_from([low, high])
    if isinstance(row.default, tuple):
        if len(row.default) == 6:  # a pose, whose angles are no degrees
            angle = st.floats(-2.0 * math.pi, 2.0 * math.pi)
            return st.tuples(*[number] * 3, *[angle] * 3)
        return st.lists(number, min_size=len(row.default), max_size=len(row.default))
    return number


@pytest.mark.parametrize('name', ['sensor_pose', 'initial_pose'])
def test_angles_of_a_pose_in_degrees_are_refused(name):
    kind = Settings if name == 'initial_pose' else InputSettings
    with pytest.raises(ParameterError, match=f"'{name}': roll, pitch and yaw are radians"):
        from_parameters(kind, {name: [0.0, 0.0, 0.0, 0.0, 0.0, 90.0]})


@settings(max_examples=10)
@given(junk)
def test_whatever_is_given_there_are_settings_or_a_parameter_error(value):
    for row in table(Settings):
        try:
            made = from_parameters(Settings, {row.name: value})
        except ParameterError as error:
            assert row.name in str(error)
            assert '\n' not in str(error)
        else:
            assert type(getattr(made, row.name)) is type(row.default)


@settings(max_examples=25)
@given(st.fixed_dictionaries({}, optional={row.name: values_of(row) for row in table(Settings)}))
def test_what_is_in_range_is_taken_and_makes_an_estimator(values):
    made = from_parameters(Settings, values)
    for row in table(Settings):
        assert type(getattr(made, row.name)) is type(row.default), row.name
    assert Estimator(made).settings == made


@pytest.mark.parametrize(
    'path',
    sorted(set(CONFIG_FOLDER.glob('*.yaml')) - {CONFIG_FOLDER / 'simulator.yaml'}),
    ids=lambda path: path.name,
)
def test_shipped_files_hold_only_parameters_that_exist_with_values_that_fit(path):
    rows = {
        row.name: row for settings in (Settings, ObserverNodeSettings) for row in table(settings)
    }
    values = read_parameter_file(path)
    assert values
    for name, value in values.items():
        rows[name].check(value)


def test_some_files_are_shipped():
    names = {path.name for path in CONFIG_FOLDER.glob('*.yaml')}
    assert {'wheeled_bearing_range.yaml', 'stereo_inertial.yaml'} <= names


def write(folder, text):
    path = folder / 'parameters.yaml'
    path.write_text(text, encoding='utf-8')
    return path


@pytest.mark.parametrize(
    'section',
    [
        '/**', '/*', 'observer_node', '/observer_node', '/robot/observer_node', '/robot/**',
        '/robot/*', '/*/observer_node', '/**/observer_node', '/**/robot/*', '/fleet/*/**',
    ],
)  # fmt: skip
def test_sections_of_this_node_are_read_and_those_of_others_left_out(tmp_path, section):
    path = write(
        tmp_path,
        f'{section}:\n  ros__parameters:\n    gains: constant\n    nested: {{deep: 1}}\n'
        'camera:\n  ros__parameters:\n    exposure: 3\n',
    )
    assert read_parameter_file(path) == {'gains': 'constant', 'nested.deep': 1}


@pytest.mark.parametrize('namespaces', [['robot1'], ['/fleet', 'robot1'], ['a', '/**', 'b/c']])
def test_a_node_may_be_below_its_namespaces(tmp_path, namespaces):
    tree = {
        'observer_node': {'ros__parameters': {'gains': 'constant'}},
        'camera': {'ros__parameters': {'exposure': 3}},
    }
    for name in reversed(namespaces):
        tree = {name: tree}
    assert read_parameter_file(write(tmp_path, yaml.dump(tree))) == {'gains': 'constant'}


@pytest.mark.parametrize(
    ('sections', 'used'),
    [
        (['/robot1/observer_node', '/robot1/**', '/*/observer_node', '/**'], 'abcd'),
        (['/robot1/observer_node', '/camera/**', '/*', '/robot2/*', '/**/observer_node'], 'ae'),
        (['/observer_node', '/*', '/camera/**', '/*/*'], 'ab'),
        (['/**', '/robot1/**', '/*/observer_node', '/**/robot1/*'], 'abcd'),
        (['/**/camera', 'observer*', '/camera/*/left', '/**'], 'd'),
    ],
)
def test_wildcards_are_of_the_node_as_in_ros(tmp_path, sections, used):
    tree = {
        section: {'ros__parameters': {name: 1}}
        for section, name in zip(sections, 'abcde', strict=False)
    }
    assert ''.join(sorted(read_parameter_file(write(tmp_path, yaml.dump(tree))))) == used


@pytest.mark.parametrize(
    ('sections', 'reported'),
    [
        ({'/slam_node': ['gains', 'use_sim_time']}, ['/slam_node']),
        ({'robot2/observer_node': ['gains', 'range_noise']}, ['/robot2/observer_node']),
        ({'/slam_node': ['gains'], '/**': ['use_sim_time']}, ['/slam_node']),
        ({'/slam_node': ['gains'], '/**': ['two_d_mode']}, []),
        ({'/robot1/observer_node': ['gains'], '/robot2/observer_node': ['gains']}, []),
        ({'/amcl': ['base_frame', 'min_particles', 'max_particles']}, []),
        ({'/**': ['use_sim_time']}, []),
        ({}, []),
    ],
)
def test_parameters_that_seem_to_be_under_a_wrong_name_are_found(tmp_path, sections, reported):
    tree = {
        section: {'ros__parameters': dict.fromkeys(names, 1)}
        for section, names in sections.items()
    }
    ours = {row.name for row in table(Settings)} | {'base_frame'}
    path = write(tmp_path, yaml.dump(tree))
    assert misplaced_sections(path, '/robot1/observer_node', ours) == reported


def test_a_file_that_holds_itself_is_refused_in_one_line(tmp_path):
    with pytest.raises(ParameterError, match='not valid YAML'):
        read_parameter_file(write(tmp_path, 'a: &x {b: *x}\n'))


def test_later_sections_win(tmp_path):
    path = write(
        tmp_path,
        '/**:\n  ros__parameters: {gain_k: 1.0, gain_l: 2.0}\n'
        'observer_node:\n  ros__parameters: {gain_k: 3.0}\n',
    )
    assert read_parameter_file(path) == {'gain_k': 3.0, 'gain_l': 2.0}


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        (
            'observer_node: {ros__parameters: {a: 1}}\n'
            '/robot1/observer_node: {ros__parameters: {a: 2}}\n',
            'sections for /observer_node and /robot1/observer_node',
        ),
        (
            '/**: {ros__parameters: {a: 1}}\n/robot1/**: {ros__parameters: {a: 1}}\n'
            '/robot2/**: {ros__parameters: {a: 2}}\n',
            'sections for /robot2/** and /robot1/observer_node',
        ),
        ('', 'ros__parameters'),
        ('just a word', 'ros__parameters'),
        ('- a\n- b\n', 'ros__parameters'),
        ('gains: constant\n', 'ros__parameters'),
        ('camera:\n  ros__parameters: {a: 1}\n', 'ros__parameters'),
        ('/**:\n  ros__parameters: 3\n', 'ros__parameters'),
        ('/**:\n  - ros__parameters\n', 'ros__parameters'),
        ('/**: {ros__parameters: {a: 1\n', 'not valid YAML'),
        ('/**:\n\tros__parameters:\n', 'not valid YAML'),
        ('a: !!python/object:os.system x\n', 'not valid YAML'),
        ('a: 2020-13-45\n', 'not valid YAML'),
        ('a: ' + '7' * 5000, 'not valid YAML'),
        ('[' * 5000, 'not valid YAML'),
    ],
)
def test_a_file_without_parameters_is_refused_in_one_line(tmp_path, text, expected):
    path = write(tmp_path, text)
    with pytest.raises(ParameterError) as error:
        read_parameter_file(path)
    assert str(path) in str(error.value)
    assert expected in str(error.value)
    assert '\n' not in str(error.value)


def test_what_is_wrong_with_a_file_is_reported_with_its_line(tmp_path):
    path = write(tmp_path, '/**:\n  ros__parameters:\n    gain_k: [1.0\n    gain_l: 2.0\n')
    with pytest.raises(ParameterError, match=r"expected ',' or '\]', but got ':' in line 4$"):
        read_parameter_file(path)


@pytest.mark.parametrize('content', [b'\xc3(: 1', b'\x80abc: 1', b'a: "\x00"'])
def test_a_file_that_is_no_text_is_refused(tmp_path, content):
    path = tmp_path / 'parameters.yaml'
    path.write_bytes(content)
    with pytest.raises(ParameterError, match='not valid YAML'):
        read_parameter_file(path)


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    with pytest.raises(ParameterError, match='No such file'):
        read_parameter_file(tmp_path / 'missing.yaml')
    with pytest.raises(ParameterError, match='directory'):
        read_parameter_file(tmp_path)


def test_off_in_a_file_is_no_false(tmp_path):
    file = tmp_path / 'mode.yaml'
    file.write_text('/**:\n  ros__parameters:\n    localization_mode: off\n')
    settings = from_parameters(Settings, read_parameter_file(file))
    assert settings.localization_mode == 'off'


@pytest.mark.parametrize(
    ('numbers', 'is_reported'), [('[0.2, 0, 0.4]', True), ('[0.2, 0.0]', False), ('[1, 2]', False)]
)
def test_a_list_that_the_node_can_not_read_is_reported(tmp_path, numbers, is_reported):
    path = write(tmp_path, f'/**: {{ros__parameters: {{sensor_pose: {numbers}}}}}')
    assert mixed_lists(read_parameter_file(path)) == ['sensor_pose'] * is_reported


@pytest.mark.parametrize(
    ('text', 'number'),
    [
        ('2', 2.0), ('1e-3', 0.001), ('1.0e2', 100.0), ('1.E+2', 100.0), ('.5', 0.5),
        ('.5e1', 5.0), ('+.5', 0.5), ('+12.5e-1', 1.25),
    ],
)  # fmt: skip
def test_numbers_in_a_file_are_read_as_ros_reads_them(tmp_path, text, number):
    path = write(tmp_path, f'/**:\n  ros__parameters:\n    gain_k: {text}\n')
    assert from_parameters(Settings, read_parameter_file(path)).gain_k == number


@pytest.mark.parametrize(
    ('text', 'twice'),
    [
        (
            '/**:\n  ros__parameters:\n    gain_k: 1.0\n    gain_l: 2.0\n    gain_k: 3.0\n',
            'gain_k',
        ),
        ('/**: {ros__parameters: {a: 1}}\n/**: {ros__parameters: {b: 2}}\n', '/**'),
    ],
)
def test_what_a_file_has_twice_is_refused_by_its_name(tmp_path, text, twice):
    with pytest.raises(ParameterError) as error:
        read_parameter_file(write(tmp_path, text))
    assert f"'{twice}' is there 2 times" in str(error.value)


def test_scripts_may_state_the_pose_at_the_start_in_parts():
    """Scripts of snapshots before 0.1.0 do so; files state ``initial_pose``."""
    found = Settings(initial_position=(1.0, 2.0, 3.0), initial_yaw=0.5)
    assert found.initial_pose == (1.0, 2.0, 3.0, 0.0, 0.0, 0.5)
    assert replace(found, gain_k=2.0).initial_pose == found.initial_pose
    assert 'initial_yaw' not in {row.name for row in table(Settings)}
