"""``slam-observer config``: parameter files of the package, whole ones, and their schema.

With a JSON schema editors complete and check them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
import json
import math
import sys

from slam_observer_ros.cli.options import config_files, find_config, options, shipped_names
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.files import not_special
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.settings.parameter_file import (
    names_of_others,
    parameter_file_text,
    read_parameter_file,
)
from slam_observer_ros.settings.parameter_table import Parameter, table

DRAFT = 'http://json-schema.org/draft-07/schema#'
"""The draft that editors' YAML plug-ins know."""


OTHER_NODES = {'simulator_node$': {'type': ['object', 'null']}}
"""Sections of nodes that have other parameters of the same names."""


def parameter_schema(rows: Iterable[Parameter]) -> dict[str, object]:
    """Return the schema of a file with these parameters, whatever its nodes are called.

    Others are not refused: a file may be shared with other nodes.
    """
    values = {row.name: value_schema(row) for row in rows}
    section = {
        'type': ['object', 'null'],
        'properties': {'ros__parameters': {'$ref': '#/definitions/parameters'}},
        'patternProperties': OTHER_NODES,
        'additionalProperties': {'$ref': '#/definitions/section'},
    }
    return {
        '$schema': DRAFT,
        'title': 'Parameters of observer_node',
        'type': 'object',
        'patternProperties': OTHER_NODES,
        'additionalProperties': {'$ref': '#/definitions/section'},
        'definitions': {
            'section': section,
            'parameters': {'type': ['object', 'null'], 'properties': values},
        },
    }


def value_schema(row: Parameter) -> dict[str, object]:
    """Return the schema of a parameter's value."""
    unit = f' [{row.unit}]' if row.unit else ''
    schema: dict[str, object] = {'description': row.description + unit}
    default = row.default
    if isinstance(default, tuple):
        length = len(default)
        entries = {'type': 'number'} | _bounds(row)
        schema |= {'type': 'array', 'items': entries, 'minItems': length, 'maxItems': length}
        return schema | {'default': list(default)}
    if isinstance(default, bool):
        schema['type'] = 'boolean'
    elif isinstance(default, str):
        # YAML 1.1, which ROS reads, has a plain off for false.
        off = [False] if 'off' in row.choices else []
        schema |= {'enum': [*row.choices, *off]} if row.choices else {'type': 'string'}
    else:
        schema |= {'type': 'integer' if isinstance(default, int) else 'number'} | _bounds(row)
    return schema | {'default': default}


def _bounds(row: Parameter) -> dict[str, object]:
    bounds = {'minimum': row.minimum, 'maximum': row.maximum}
    return {name: bound for name, bound in bounds.items() if math.isfinite(bound)}


ROWS = (*table(ObserverNodeSettings), *table(Settings))  # all parameters of ``observer_node``


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Without a name, list the parameter files that come with the package; with one, print it.'
    )
    options(
        parser,
        'name NAME: a parameter file, or the name of one of those',
        name={'nargs': '?', 'completer': config_files},
    )
    options(
        parser.add_mutually_exclusive_group(),
        """
        --dump: print all parameters of observer_node, at the values of NAME or their defaults, and
            what each is
        --schema: print a JSON schema of parameter files, with which editors complete and check
            them
        """,
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Print what was asked for."""
    if args.schema and args.name is not None:
        raise UsageError('--schema is the same for all parameter files; leave NAME out')
    if args.schema:
        text = json.dumps(parameter_schema(ROWS), indent=2, ensure_ascii=False) + '\n'
    elif args.dump:
        rows: dict[str, Parameter] = {row.name: row for row in ROWS}
        written = {} if args.name is None else read_parameter_file(find_config(args.name))
        others = names_of_others(written, rows)
        values = {name: rows[name].check(written[name]) for name in written if name not in others}
        text = parameter_file_text(ROWS, values)
    elif args.name is None:
        text = ''.join(f'{name}\n' for name in shipped_names())
    else:
        text = not_special(find_config(args.name)).read_text(encoding='utf-8')
    sys.stdout.write(text)
