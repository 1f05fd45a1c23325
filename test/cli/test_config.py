"""``slam-observer config``: files of the package, whole ones, and the schema of all of them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from slam_observer_ros.cli.config import ROWS
from slam_observer_ros.settings.parameter_file import mixed_lists, read_parameter_file

CONFIGS = Path(__file__).parents[2] / 'config'


@pytest.fixture(name='schema')
def fixture_schema(slam_observer):
    return slam_observer.succeed('config', '--schema').json


def parameters(**values):
    return {'/robot': {'observer_node': {'ros__parameters': values}}}


def test_files_of_the_package_are_listed_and_shown(slam_observer):
    names = slam_observer.succeed('config').output.split()
    assert {'observer', 'wheeled_bearing_range'} <= set(names)
    assert 'simulator' not in names
    for name in names:
        shown = slam_observer.succeed('config', name).output
        assert shown == (CONFIGS / f'{name}.yaml').read_text()


@pytest.mark.parametrize('name', [None, 'wheeled_bearing_range', 'stereo_inertial'])
def test_a_dump_has_every_parameter_and_reads_back_as_it_is(slam_observer, tmp_path, name):
    given = [] if name is None else [name]
    path = tmp_path / 'all.yaml'
    path.write_text(slam_observer.succeed('config', *given, '--dump').output)
    values = read_parameter_file(path)
    written = {} if name is None else read_parameter_file(CONFIGS / f'{name}.yaml')
    assert list(values) == [row.name for row in ROWS]
    assert not mixed_lists(values)
    for row in ROWS:
        assert row.check(values[row.name]) == row.check(written.get(row.name, row.default))
        # To ROS, 1 is an integer and no parameter that takes 1.0.
        assert isinstance(values[row.name], list) or (type(values[row.name]) is type(row.default))


@pytest.mark.parametrize('file', sorted(CONFIGS.glob('*.yaml')), ids=lambda file: file.stem)
def test_files_of_the_package_fit_the_schema(schema, file):
    jsonschema.Draft7Validator.check_schema(schema)
    jsonschema.validate(yaml.safe_load(file.read_text()), schema)


@pytest.mark.parametrize(
    'wrong',
    [{'gains': 'large'}, {'range_noise': -1.0}, {'two_d_mode': 'yes'}, {'confirmations': 0},
     {'angular_velocity_noise': [0.1, 0.1]}, {'publish_rate': 'fast'}],
    ids=str,
)  # fmt: skip
def test_what_a_node_would_refuse_does_not_fit_the_schema(schema, wrong):
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(parameters(**wrong), schema)


def test_parameters_of_other_nodes_are_no_fault(schema):
    jsonschema.validate(parameters(gains='riccati', port='/dev/ttyUSB0'), schema)


def test_every_parameter_is_described_in_the_schema(schema):
    described = schema['definitions']['parameters']['properties']
    assert list(described) == [row.name for row in ROWS]
    assert all(entry['description'] for entry in described.values())
    assert json.loads(json.dumps(schema)) == schema


def test_what_is_wrong_is_said_in_one_line(slam_observer, tmp_path):
    path = tmp_path / 'wrong.yaml'
    path.write_text('/**: {ros__parameters: {range_noise: -1.0}}')
    assert 'range_noise' in slam_observer.fail('config', path, '--dump')
    assert 'no parameter file' in slam_observer.fail('config', 'nothing', '--dump')
    assert 'leave NAME out' in slam_observer.fail('config', 'observer', '--schema')
