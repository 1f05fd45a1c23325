"""Files of anybody's, given as a map or as parameters: read or refused, in one short line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
import pytest

from slam_observer_ros.common.errors import MapError, ParameterError, SlamObserverError
from slam_observer_ros.mapping.map_file import MAX_BYTES as MAX_MAP_BYTES
from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.settings.parameter_file import MAX_BYTES, read_parameter_file

MAP = """\
format: slam_observer_ros map
version: {}
frame: map
landmarks: [{{id: 1, position: {}}}]
"""
PARAMETERS = '{ros__parameters: {gains: riccati}}\n'
BOMB = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{name}: &{name} [{", ".join([f"*{below}"] * 9)}]\n'
    for below, name in zip('abcdefghijklmn', 'bcdefghijklmno', strict=True)
)
HOSTILE = {
    'an alias bomb': BOMB + MAP.format('*o', '[0, 0, 0]'),
    'an alias bomb of mappings': BOMB + '/**: {ros__parameters: {gain_k: *o}}',
    'a recursive alias': 'a: &a [*a]\n' + MAP.format('*a', '*a'),
    'a recursive alias of parameters': '/**: {ros__parameters: &a {b: *a}}',
    'a merged mapping': '/**: {ros__parameters: {<<: {gain_k: 1.0}, <<: 3}}',
    'no bool': MAP.format('!!bool x', '!!bool x') + '/**: {ros__parameters: {a: !!bool x}}',
    'no int': MAP.format('!!int ""', '!!int ""') + '/**: {ros__parameters: {a: !!int ""}}',
    'no float': MAP.format('!!float x', '!!float ""'),
    'no time': MAP.format('!!timestamp x', '!!timestamp 2020-99-99'),
    'no set': MAP.format('!!set [1]', '!!omap x'),
    'another tag': MAP.format('!!python/name:os.system', '!x 3'),
    'long numbers': MAP.format('7' * 5000, '9' * 5000),
    'a long word': MAP.format('x' * 200_000, '[1, 2, 3]'),
    'long names': '/**:\n  ros__parameters:\n    gains: a\n    ? ' + 'x' * 200_000 + '\n    : 1',
    'many names': '/**: {ros__parameters: {gains: riccati'
    + ''.join(f', n{n:x}: 1' for n in range(20_000))
    + '}}',
    'a long section': '/' + 'x' * 200_000 + '/**: {ros__parameters: {a: 1}}',
    'many wildcards': f'{"/**" * 28}/a: {PARAMETERS}{"/a" * 100}: {PARAMETERS}',
    'more wildcards': f'{"/**/a" * 40}/b/observer_node: {PARAMETERS}'
    f'{"/a" * 100}/observer_node: {PARAMETERS}',
    'many sections': ''.join(f'/**/{n}: {{ros__parameters: {{a: 1}}}}\n' for n in range(6000)),
    'many levels of lists': 'a: ' + '[' * 100_000,
    'many levels of mappings': '{a: ' * 50_000,
    'many levels of lines': '- ' * 100_000,
    'many levels of keys': '? ' * 100_000,
    'nested parameters': '/**: {ros__parameters: ' + '{a: ' * 500 + '1' + '}' * 502,
    'a list as a key': '{[1]: 2}',
    'several documents': '--- 1\n--- 2\n',
    'no text': '\0',
}  # fmt: skip


def refusal(read: Callable[[Path], object], path: Path) -> str:
    """Return why a file is refused; empty if it is read."""
    try:
        read(path)
    except SlamObserverError as error:
        return str(error)
    return ''


@pytest.mark.parametrize('read', [read_map, read_parameter_file])
@pytest.mark.parametrize('content', HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_file_is_refused_in_one_short_line(tmp_path, content, read):
    path = tmp_path / 'file.yaml'
    path.write_text(content)
    reason = refusal(read, path)
    assert len(reason) < 300 + len(str(path))
    assert '\n' not in reason


@pytest.mark.parametrize('name', ['long names', 'many names'])
def test_a_replay_shortens_what_it_says_of_hostile_parameters(slam_observer, tmp_path, name):
    path = tmp_path / 'file.yaml'
    path.write_text(HOSTILE[name])
    ended = slam_observer('replay', 'no.mcap', '--config', path)
    assert ended.code == 2
    assert 'n0' in ended.errors or 'xxx' in ended.errors
    assert len(ended.errors) < 1500


def test_aliases_are_refused_by_name(tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_text('a: &a 1\nb: *a\n')
    for read in (read_map, read_parameter_file):
        assert 'an alias, which is not taken, in line 2' in refusal(read, path)


def test_larger_files_than_any_map_or_parameters_are_not_read(tmp_path):
    path = tmp_path / 'file.yaml'
    for read, most in ((read_map, MAX_MAP_BYTES), (read_parameter_file, MAX_BYTES)):
        with path.open('wb') as file:
            file.truncate(most + 1)
        assert refusal(read, path).endswith(f'it has more than {most / 1e6:g} MB')


@given(st.text('[]{}:,-&*!?<>|\'"#%@ \nab01.e~', max_size=60))
def test_no_text_makes_anything_but_errors_of_their_own(tmp_path_factory, text):
    path = tmp_path_factory.mktemp('text') / 'file.yaml'
    path.write_text(text)
    with pytest.raises(MapError):
        read_map(path)
    with pytest.raises(ParameterError):
        read_parameter_file(path)
