"""A whole parameter file, with what each parameter is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import json
import textwrap

from slam_observer_ros.settings.parameter_table import Parameter, Value

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
