"""A JSON schema of parameter files, with which editors complete and check them."""

from __future__ import annotations

from collections.abc import Iterable
import math

from slam_observer_ros.settings.parameter_table import Parameter

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
        schema |= {'type': 'string'} if not row.choices else _choices(row)
    else:
        schema |= {'type': 'integer' if isinstance(default, int) else 'number'} | _bounds(row)
    return schema | {'default': default}


def _choices(row: Parameter) -> dict[str, object]:
    # YAML 1.1, which ROS reads, has a plain off for false.
    off = [False] if 'off' in row.choices else []
    return {'enum': [*row.choices, *off]}


def _bounds(row: Parameter) -> dict[str, object]:
    bounds = {'minimum': row.minimum, 'maximum': row.maximum}
    return {name: bound for name, bound in bounds.items() if math.isfinite(bound)}
