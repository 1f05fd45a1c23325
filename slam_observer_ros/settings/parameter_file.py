"""ROS 2 parameter files, read and written without ROS."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
import json
from pathlib import Path
import re
import textwrap

from slam_observer_ros.common.errors import failing, OutputError, ParameterError, shown, YamlError
from slam_observer_ros.common.files import load_yaml, plain_value, unfinished_file
from slam_observer_ros.settings.parameter_table import Parameter, suggestion, Value

OBSERVER_NODE = 'observer_node'

MAX_BYTES = 256_000  # largest file that is read; whole robots' have a tenth of it
MAX_NAME = 255  # longest name of a node with its namespaces, as in ROS, and of a parameter

_ROS_FLOAT = re.compile(r'[-+]?(?:\d+\.?\d*[eE][-+]?\d+|\.\d+(?:[eE][-+]?\d+)?)')


def names_of_others(written: Iterable[str], ours: Collection[str]) -> list[str]:
    """Return the names that are not ours: a parameter file may be shared with other nodes.

    Raises
    ------
    ParameterError
        If one is one of ours with a single mistake. With more of them it may well be another
        node's: ``base_frame_id`` comes near, too.

    """
    others = [name for name in written if name not in ours]
    for name in others:
        if near := suggestion(name, [our for our in ours if _is_misspelt(name, our)]):
            raise ParameterError(f"unknown parameter '{name}'{near}")
    return others


def read_parameter_file(path: Path) -> dict[str, object]:
    """Return the name → value mapping of a ROS 2 parameter file.

    The file has the usual form ``<node or /**>: ros__parameters: {name: value}``, the node maybe
    below its namespaces; nested mappings become dotted names. Sections of other nodes are left
    out. In the names of sections ``*`` stands for one name, and ``**`` for any number of them.
    What is not readable, not YAML, has a key twice, no parameters for this package, or some for
    several robots, is a ParameterError.
    """
    sections = [(name, body) for name, body in _read_sections(path) if _fits(name, _node_of(name))]
    if not sections:
        raise ParameterError(
            f"parameter file {path} has no '/**: ros__parameters:' or "
            f"'{OBSERVER_NODE}: ros__parameters:' section"
        )
    node = _only_node(path, [name for name, _ in sections])
    values: dict[str, object] = {}
    for name, body in sections:
        if _fits(name, node):
            values.update(_flatten(body))
    _refuse_long_names(path, 'parameter', values)
    return values


def misplaced_sections(path: Path, node: str, ours: Collection[str]) -> list[str]:
    """Return the sections of other nodes that seem to be meant for a node, as none is of it.

    ``node`` is its full name, and most parameters of such a section are among ``ours``. A file
    that can't be read is a ParameterError.
    """
    misplaced = []
    for name, body in _read_sections(path):
        written = set(_flatten(body)) - {'use_sim_time'}
        known = written.intersection(ours)
        if known and _fits(name, node):
            return []
        if 2 * len(known) > len(written):
            misplaced.append(name)
    return misplaced


def mixed_lists(values: Mapping[str, object]) -> list[str]:
    """Return the names of lists that ROS can't read: some numbers are integers, and some not."""
    return [
        name
        for name, value in values.items()
        if isinstance(value, list) and {int, float} <= {type(entry) for entry in value}
    ]


def _is_misspelt(name: str, ours: str) -> bool:
    """Return whether a letter of ``ours`` is wrong, missing, too many or behind the next one."""
    if abs(len(name) - len(ours)) > 1:
        return False
    same = [one == other for one, other in zip(name, ours, strict=False)]
    start = [*same, False].index(False)
    rest, right = name[start:], ours[start:]
    swapped = right[1:2] + right[:1] + right[2:]
    return rest in (right[1:], swapped) or rest[1:] in (right, right[1:])


def _plain_value(text: str) -> object:
    """Read numbers as ROS does: 1e-3 and 1.0e3, too, where YAML 1.1 wants 1.0e-3 and 1.0e+3."""
    return float(text) if _ROS_FLOAT.fullmatch(text) else plain_value(text)


def _read_sections(path: Path) -> list[tuple[str, dict[str, object]]]:
    try:
        content = load_yaml(path, MAX_BYTES, _plain_value)
    except OSError as error:
        raise ParameterError(f"can't read parameter file {path}: {error.strerror}") from error
    except YamlError as error:
        raise ParameterError(f'parameter file {path} is not valid YAML: {error}') from error
    sections = list(_sections(content if isinstance(content, dict) else {}))
    _refuse_long_names(path, 'section', [name for name, _ in sections])
    return sections


def _refuse_long_names(path: Path, what: str, names: Iterable[str]) -> None:
    for name in names:
        if len(name) > MAX_NAME:
            raise ParameterError(
                f'parameter file {path}: the {what} {shown(name)} has more than {MAX_NAME} letters'
            )


def _sections(
    tree: Mapping[object, object], namespace: str = ''
) -> Iterator[tuple[str, dict[str, object]]]:
    """Yield the nodes of a parameter file by their full names, and their parameters."""
    for key, body in tree.items():
        name = f'{namespace}/{str(key).lstrip("/")}'
        if not isinstance(body, dict):
            continue
        if 'ros__parameters' not in body:  # the name is a namespace
            yield from _sections(body, name)
        elif isinstance(body['ros__parameters'], dict):
            yield name, body['ros__parameters']


def _fits(section: str, node: str) -> bool:
    """Return whether a section is of the node with this full name, as ROS has it."""
    names = node.split('/')[1:]
    fitted = {0}  # how many of the node's names the section may be of so far
    for name in section.split('/')[1:]:
        if name == '**':
            fitted = set(range(min(fitted), len(names) + 1))
        else:
            fitted = {
                count + 1 for count in fitted if count < len(names) and name in ('*', names[count])
            }
        if not fitted:
            return False
    return len(names) in fitted


def _node_of(section: str) -> str:
    """Return the full name of the observer's node that a section is of, if it is of one."""
    names = [name for name in section.split('/')[1:] if name != '**']
    namespaces = names[:-1] if names and names[-1] in ('*', OBSERVER_NODE) else names
    return '/'.join(['', *namespaces, OBSERVER_NODE])


def _only_node(path: Path, sections: Sequence[str]) -> str:
    """Return the full name of the observer's node that a file is of.

    Where a section names it, those with wildcards may be of other nodes.
    """
    named = [section for section in sections if '*' not in section] or sections
    node = max(map(_node_of, named), key=lambda name: (name.count('/'), '*' not in name))
    for section in named:
        if not _fits(section, node):
            raise ParameterError(
                f'parameter file {path} is of several robots: it has sections for {section} and '
                f'{node}; leave one'
            )
    return node


def _flatten(tree: Mapping[str, object], prefix: str = '') -> dict[str, object]:
    flat: dict[str, object] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat.update(_flatten(value, f'{prefix}{name}.'))
        else:
            flat[f'{prefix}{name}'] = value
    return flat


WIDTH = 95


def parameter_file_text(rows: Iterable[Parameter], values: Mapping[str, Value]) -> str:
    """Return a parameter file with all parameters, at their defaults where ``values`` has none."""
    lines = ['/**:', '  ros__parameters:']
    for row in rows:
        facts = ', '.join(fact for fact in (row.unit, row.range_text()) if fact)
        comment = f'{row.description} ({facts})' if facts else row.description
        lines += textwrap.wrap(comment, WIDTH, initial_indent='    # ', subsequent_indent='    # ')
        lines.append(f'    {row.name}: {value_text(values.get(row.name, row.default))}')
    return '\n'.join(lines) + '\n'


def value_text(value: object) -> str:
    """Return a value as YAML whose type ROS reads right: numbers with a point, as 1.0e-06."""
    if isinstance(value, (tuple, list)):
        return f'[{", ".join(value_text(entry) for entry in value)}]'
    if isinstance(value, float):
        mantissa, e, exponent = repr(value).partition('e')
        return mantissa if not e else f'{mantissa}{"" if "." in mantissa else ".0"}e{exponent}'
    return json.dumps(value, ensure_ascii=False)


def write_found(
    path: Path,
    head: Sequence[str],
    given: Mapping[str, object],
    found: Sequence[tuple[str, Mapping[str, object]]],
) -> None:
    """Write parameters as given but for those found, which have a comment for each group."""
    names = {name for _, values in found for name in values}
    lines = [*(f'# {line}' for line in head), '/**:', '  ros__parameters:']
    others = {name: value for name, value in given.items() if name not in names}
    if others:
        lines += ['    # As it was given', *(_entry(name, others[name]) for name in others)]
    for comment, values in found:
        lines += ['', *(f'    # {line}' for line in comment.splitlines())]
        lines += [_entry(name, value) for name, value in values.items()]
    with failing(OutputError, f"can't write {path}"), unfinished_file(path) as file:
        file.write('\n'.join(lines) + '\n')


def _entry(name: str, value: object) -> str:
    return f'    {name}: {value_text(value)}'
