"""What several commands share: options of settings and outputs, and typed values.

Output files are refused before the work if they are in the way.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from inspect import cleandoc
import json
import logging
import os
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any, TYPE_CHECKING

from slam_observer_ros.common.errors import ParameterError, UsageError
from slam_observer_ros.common.findings import in_brief
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import (
    InputSettings,
    ObserverNodeSettings,
    short_names,
)
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

if TYPE_CHECKING:
    from slam_observer_ros.runs.result import Request

logger = logging.getLogger(__name__)

MAX_LISTED = 20  # most names that a warning gives

_PACKAGE = 'slam_observer_ros'
_ESTIMATOR_NAMES = frozenset(row.name for row in table(Settings))
_NODE_NAMES = frozenset(row.name for row in table(ObserverNodeSettings))
_ROS_NAMES = ('use_sim_time', 'qos_overrides.', 'start_type_description_service')
"""Parameters that every ROS node has; a name that ends with a dot stands for all below it."""


FORCE = '--force: replace files that exist already'


def options(group: Any, text: str, **more: Mapping[str, Any]) -> None:
    """Add options to a parser or a group of it, each by a line of ``text`` as help shows it.

    A line has names, what the option takes, a colon and the help; it may go on in lines that are
    indented. By what an option takes its value is a name, a path, a number or a text. ``more`` are
    other arguments of ``add_argument`` for some options, and a ``completer`` of their values.
    """
    types: dict[str, Any] = {'TOPIC': named, 'FRAME': named, 'NAME': named}
    files = ('FILE', 'DIR', 'FOLDER', 'RECORDING', 'MAP', 'SURVEY', 'OUT')
    types |= dict.fromkeys(files, lambda text: Path(named(text)))
    types |= {'ID': int, 'N': int, 'S': float, 'OUT.mcap': recording_path}
    for line in re.split(r'\n(?=\S)', cleandoc(text)):
        words, _, help_text = line.partition(': ')
        *names, last = words.split()
        given: dict[str, Any] = {'metavar': last, 'type': types.get(last)}
        if not names or last.startswith('-'):
            names.append(last)
            given = {}
        own = dict(more.get(names[-1].lstrip('-').replace('-', '_'), {}))
        completer = own.pop('completer', None)
        if not (given or own):
            given['action'] = 'store_true'
        elif given and given['type'] is None:
            given['type'] = types.get(last.partition('.')[0])
        action = group.add_argument(*names, help=' '.join(help_text.split()), **(given | own))
        if completer is not None:
            action.completer = completer  # as argcomplete takes it


def add_settings_options(parser: argparse.ArgumentParser, *others: type[Dataclass]) -> None:
    """Add ``--config``, ``--gains`` and ``--set``, with the names in the tables that it takes."""
    rows = [*table(Settings), *(row for other in others for row in table(other))]
    gains = next(row for row in rows if row.name == 'gains')
    options(
        parser.add_argument_group('estimator'),
        """
        --config FILE: the observer node's parameter file, or the name of one that comes with the
            package
        --gains: what sets the gains
        --set NAME=VALUE: set a parameter; may be given several times
        """,
        config={'type': named, 'completer': config_files},
        gains={'choices': gains.choices},
        set={
            'action': 'append',
            'default': [],
            'completer': lambda **_: [f'{row.name}=' for row in rows],
        },
    )
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


def read_given(args: argparse.Namespace) -> Given:
    """Read what the options of :func:`add_settings_options` give."""
    file = None if args.config is None else find_config(args.config)
    config = {} if file is None else read_parameter_file(file)
    assigned = {}
    for text in args.set:
        name, equals, value = text.partition('=')
        if not (name and equals):
            raise UsageError(f"--set takes NAME=VALUE, not '{text}'")
        assigned[name] = parse_value(value)
    return Given(file, config, assigned, args.gains)


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
            in_brief(mixed, MAX_LISTED, ', '),
        )
    if unknown:
        listed = in_brief(unknown, MAX_LISTED, ', ')
        logger.warning('Unknown parameters of --config are ignored: %s.', listed)
    return {name: value for name, value in values.items() if name in _ESTIMATOR_NAMES}


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
    names = []
    for name, file in _shipped_configs().items():
        with suppress(ParameterError):
            names += [name] if read_parameter_file(file) else []
    return sorted(names)


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


_INPUT_ROWS = {row.name: row for row in table(InputSettings)}

INSTEAD = {'map_file': '--load-map', 'autosave_map': '--map', 'velocity_type': '--velocity-topic'}
"""Options of a replay for what the node does by these parameters."""


def add_input_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of topics and inputs."""
    landmarks, ambiguous = (
        ', '.join(short_names('landmarks', is_ambiguous)) for is_ambiguous in (False, True)
    )
    options(
        parser.add_argument_group(
            'topics', 'found by their types; a name is needed only where two fit'
        ),
        f"""
        --velocity-topic TOPIC: {', '.join(short_names('velocity'))}
        --landmarks-topic TOPIC: {landmarks}, clouds with ids; if named here or called landmarks,
            also clouds without, and {ambiguous}; if named, /tf with fiducials
        --imu TOPIC: take the angular velocity from this Imu, the linear one as before
        --pose-truth-topic TOPIC: true pose: {', '.join(short_names('pose'))}
        --landmark-truth-topic TOPIC: true landmarks
        """,
    )
    options(
        parser.add_argument_group(
            'inputs', "the node's parameters of these names, which --config and --set give as well"
        ),
        f"""
        --velocity-source: what of Odometry is used: its twist (default), or the differences of its
            poses
        --base-frame FRAME: frame whose pose is estimated; other sensors are placed in it by /tf
            and /tf_static (default: the velocities' frame, or base_link if they name none)
        --tag-frame-prefix PREFIX: fiducials on /tf: a tag's frame before its id (default:
            {_INPUT_ROWS['tag_frame_prefix'].default}); family:id is known, too
        """,
        velocity_source={'choices': _INPUT_ROWS['velocity_source'].choices},
    )


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a recording is replayed, but for settings."""
    add_input_options(parser)
    options(
        parser,
        """
        --load-map FILE: known landmarks, as --map writes them, or a folder of such maps, one of
            them the map of the place: the estimate is then in their frame, and has no ANEES of
            the pose (nor of the configuration, if they are fixed)
        --smooth: estimate trajectory and map from all observations together, too; --tum and --map
            then write these
        """,
    )


def read_request(args: argparse.Namespace, given: Given, recording: Path) -> Request:
    """Return what the options of :func:`add_run_options` ask for, without any output.

    A SlamObserverError is raised if settings are wrong, or don't fit the options.
    """
    from slam_observer_ros.recordings.topics import TopicNames  # which some commands do without
    from slam_observer_ros.runs.result import Request

    defaults = {'smoothing_window': 0} if args.smooth else {}
    topics = TopicNames(
        args.velocity_topic,
        args.landmarks_topic,
        args.pose_truth_topic,
        args.landmark_truth_topic,
        args.imu,
    )
    settings = settings_of(given, _INPUT_ROWS, INSTEAD, **defaults)
    # Of --config, --set and the options themselves later ones win.
    values: dict[str, object] = {'base_frame': ''}
    values |= {name: value for name, value in given.values.items() if name in _INPUT_ROWS}
    options = {
        'velocity_source': args.velocity_source,
        'base_frame': args.base_frame,
        'tag_frame_prefix': args.tag_frame_prefix,
        'use_imu': None if args.imu is None else True,
    }
    values |= {name: value for name, value in options.items() if value is not None}
    inputs = from_parameters(InputSettings, values).with_plain_frames()
    return Request(recording, settings, inputs, topics, args.load_map, args.smooth)


def warn_of_unused(args: argparse.Namespace, given: Given) -> None:
    """Warn of what ``--config`` sets for the node, while the option for it here isn't given."""
    defaults = {row.name: row.default for row in table(ObserverNodeSettings)}
    unused = [
        f'{name} (use {INSTEAD[name]})'
        for name, value in given.config.items()
        if name in INSTEAD
        and value != defaults[name]
        and getattr(args, INSTEAD[name].removeprefix('--').replace('-', '_')) is None
    ]
    if unused:
        logger.warning('Not used of --config: %s.', ', '.join(unused))


def recording_path(text: str) -> Path:
    """Take the name of a recording to be made, as an argparse type."""
    path = Path(text)
    if path.suffix != '.mcap':
        raise argparse.ArgumentTypeError(f"recordings are .mcap files, so not '{text}'")
    return path


def check_outputs(
    outputs: Mapping[str, Path | None],
    force: bool,
    read: Mapping[str, Iterable[Path]] = MappingProxyType({}),
) -> None:
    """Raise a UsageError if an output can't be written, not without ``force``, or replaces input.

    Outputs are by option, None where not asked for; files that are ``read`` by what they are.
    """
    kept = {os.path.realpath(f): what for what, files in read.items() for f in files}
    wanted = {option: file for option, file in outputs.items() if file is not None}
    for option, file in wanted.items():
        if (what := kept.get(os.path.realpath(file))) is not None:
            raise UsageError(f'{option} {file} would replace {what}; give another name')
    others: list[Path] = []
    for file in wanted.values():
        if file.is_dir():
            raise UsageError(f'{file} is a directory; give the name of a file')
        real = Path(os.path.realpath(file))  # which fails in no circle of links
        if real.is_symlink():
            raise UsageError(f'{file} is a link to itself; give another name')
        if file.exists() and not file.is_file():
            raise UsageError(f'{file} is there, and no regular file; give another name')
        if file.exists() and not force:
            raise UsageError(f'{file} exists already; give another name, or --force to replace it')
        _check_parent(file)
        if real in others:
            raise UsageError(f'{file} is named for two outputs')
        others.append(real)


def check_directory(directory: Path) -> None:
    """Raise a UsageError if a directory is not there, and can't be made."""
    if directory.is_dir():
        return
    if os.path.lexists(directory):
        raise UsageError(f'{directory} is no directory; give the name of one')
    _check_parent(directory)


def _check_parent(path: Path) -> None:
    if not path.parent.is_dir():
        raise UsageError(f'{path}: there is no directory {path.parent}; make it first')
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f'{path}: nothing may be written to {path.parent}')


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


def value_of(row: Parameter) -> Callable[[str], Value]:
    """Return an argparse type that takes what the parameter ``row`` takes."""

    def parse(text: str) -> Value:
        try:
            return row.check(parse_value(text))
        except ParameterError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parse
