"""Command-line options that several commands share: the estimator's settings, typed values."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
import json
import logging
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any

from slam_observer_ros.cli.console import completed_by
from slam_observer_ros.common.errors import ParameterError, UsageError
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.settings.parameter_file import (
    mixed_lists,
    names_of_others,
    read_parameter_file,
)
from slam_observer_ros.settings.parameter_table import (
    Dataclass,
    from_parameters,
    Parameter,
    table,
    Value,
)

logger = logging.getLogger(__name__)

MAX_LISTED = 20
"""Most names that a warning gives."""

_PACKAGE = 'slam_observer_ros'
_ESTIMATOR_NAMES = frozenset(row.name for row in table(Settings))
_NODE_NAMES = frozenset(row.name for row in table(ObserverNodeSettings))
_ROS_NAMES = ('use_sim_time', 'qos_overrides.', 'start_type_description_service')
"""Parameters that every ROS node has; a name that ends with a dot stands for all below it."""


def add_settings_options(parser: argparse.ArgumentParser, *others: type[Dataclass]) -> None:
    """Add ``--config``, ``--gains`` and ``--set``, with the names in the tables that it takes."""
    rows = [*table(Settings), *(row for other in others for row in table(other))]
    gains = next(row for row in rows if row.name == 'gains')
    group = parser.add_argument_group('estimator')
    config = group.add_argument(
        '--config',
        type=named,
        metavar='FILE',
        help="the observer node's parameter file, or the name of one that comes with the package",
    )
    completed_by(config, config_files)
    group.add_argument('--gains', choices=gains.choices, help='what sets the gains')
    assignment = group.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='set a parameter; may be given several times',
    )
    completed_by(assignment, lambda **_: [f'{row.name}=' for row in rows])
    basic, advanced = (
        ', '.join(row.name for row in rows if row.basic == is_basic) for is_basic in (True, False)
    )
    parser.add_argument_group('parameters that a robot needs first', basic)
    parser.add_argument_group('advanced parameters', advanced)


@dataclass(frozen=True, slots=True)
class Given:
    """What ``--config``, ``--set`` and ``--gains`` give: values by name, before they are checked.

    ``config`` has the node's own parameters, too; ``file`` is where it is from.
    """

    file: Path | None
    config: Mapping[str, object]
    assigned: Mapping[str, object]
    gains: str | None

    @property
    def values(self) -> dict[str, object]:
        """All values; ``--set`` takes the place of others."""
        return {**self.config, **self.assigned}


def read_given(args: argparse.Namespace, config: str | None = None) -> Given:
    """Read what the options of :func:`add_settings_options` give; ``config`` is for its file."""
    name = args.config if config is None else config
    file = None if name is None else find_config(name)
    return Given(
        file,
        {} if file is None else read_parameter_file(file),
        dict(_parse_assignment(text) for text in args.set),
        args.gains,
    )


def settings_of(
    given: Given,
    other_names: Collection[str] = (),
    instead: Mapping[str, str] = MappingProxyType({}),
    **defaults: Value,
) -> Settings:
    """Build settings from defaults, ``--config``, ``--set`` and ``--gains``; later ones win.

    ``other_names`` are names that ``--set`` takes for other settings of the command; ``instead``
    has the options that do what the node's parameters of these names do. A SlamObserverError is
    raised if a name or a value is wrong.
    """
    values: dict[str, object] = {**defaults, **_for_estimator(given.config)}
    for name, value in given.assigned.items():
        if name in other_names:
            continue
        if _is_only_for_node(name):
            hint = f'use {instead[name]}' if name in instead else 'of no use here'
            raise UsageError(f"--set {name}: that is the node's parameter; {hint}")
        values[name] = value
    if given.gains is not None:
        values['gains'] = given.gains
    return from_parameters(Settings, values)


def _is_only_for_node(name: str) -> bool:
    if name in _ESTIMATOR_NAMES:
        return False
    return name in _NODE_NAMES or any(
        name.startswith(ros_name) if ros_name.endswith('.') else name == ros_name
        for ros_name in _ROS_NAMES
    )


def _for_estimator(values: Mapping[str, object]) -> dict[str, object]:
    """Return what of a parameter file is for the estimator.

    Other names than the observer's are ignored with a warning, as by the node: they may be other
    nodes'.
    """
    written = [name for name in values if not _is_only_for_node(name)]
    unknown = names_of_others(written, _ESTIMATOR_NAMES | _NODE_NAMES)
    if unknown and len(unknown) == len(values):
        raise ParameterError("none of the parameters of --config is the observer's")
    if mixed := mixed_lists(values):
        logger.warning(
            "The node can't read %s of --config: in ROS all numbers of a list are written alike, "
            '0.0 for 0.',
            _listed(mixed),
        )
    if unknown:
        logger.warning('Unknown parameters of --config are ignored: %s.', _listed(unknown))
    return {name: value for name, value in values.items() if name in _ESTIMATOR_NAMES}


def _listed(names: Sequence[str]) -> str:
    """Return names as text; of a great many, the first."""
    more = len(names) - MAX_LISTED
    return ', '.join([*names[:MAX_LISTED], *([f'and {more} more'] if more > 0 else [])])


def find_config(name: str) -> Path:
    """Return the path of a parameter file, or of one that comes with the package, by its name."""
    path = Path(name)
    shipped = _shipped_configs()
    if path.exists() or len(path.parts) > 1:
        return path
    if path.stem in shipped and path.suffix in ('', '.yaml'):
        return shipped[path.stem]
    if path.suffix:
        return path
    raise ParameterError(
        f"no parameter file '{name}'; with the package come: "
        f'{", ".join(shipped_names()) or "none"}'
    )


def shipped_names() -> list[str]:
    """Return the names of the parameter files of the observer that come with the package."""
    return sorted(name for name, file in _shipped_configs().items() if _is_for_observer(file))


def _is_for_observer(file: Path) -> bool:
    try:
        return bool(read_parameter_file(file))
    except ParameterError:
        return False


def config_files(**context: Any) -> Sequence[str]:
    """Complete the name of a parameter file that comes with the package, or of another one."""
    from argcomplete.completers import FilesCompleter  # where completions are asked for

    files: list[str] = FilesCompleter(('yaml', 'yml'))(**context)
    return [*shipped_names(), *files]


def _shipped_configs() -> dict[str, Path]:
    """Return the files in config/ of the source tree, or of where pip or ROS has installed it."""
    share = Path('share') / _PACKAGE / 'config'
    names = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    prefixes = [Path(name) for name in names if name]
    installed: Iterable[metadata.PackagePath] = ()
    with suppress(metadata.PackageNotFoundError):
        installed = metadata.files(_PACKAGE) or ()
    files: Iterable[Path] = (
        *(Path(__file__).parents[2] / 'config').glob('*.yaml'),
        *(Path(str(file.locate())) for file in installed if file.match(f'{share}/*.yaml')),
        *(file for prefix in reversed(prefixes) for file in (prefix / share).glob('*.yaml')),
    )
    return {file.stem: file for file in files}


def _parse_assignment(text: str) -> tuple[str, object]:
    name, equals, value = text.partition('=')
    if not (name and equals):
        raise UsageError(f"--set takes NAME=VALUE, not '{text}'")
    return name, parse_value(value)


def parse_value(text: str) -> object:
    """Read a number, true, false or a [list]; anything else is a string."""
    if text in ('True', 'False'):  # as YAML has it, too
        return text == 'True'
    with suppress(ValueError, RecursionError):  # of what is no JSON, has too many digits or levels
        return json.loads(text)
    with suppress(ValueError):
        return float(text)
    return text


def named(text: str) -> str:
    """Take a name, as an argparse type: an empty one is a mistake, often an unset variable."""
    if not text:
        raise argparse.ArgumentTypeError('the name is empty; . is this directory')
    return text


def named_path(text: str) -> Path:
    """Take the name of a file or directory, as an argparse type."""
    return Path(named(text))


def value_of(row: Parameter) -> Callable[[str], Value]:
    """Return an argparse type that takes what the parameter ``row`` takes."""

    def parse(text: str) -> Value:
        try:
            return row.check(parse_value(text))
        except ParameterError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parse
