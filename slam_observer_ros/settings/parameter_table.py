"""Typed parameter tables: each parameter is written down once, as a dataclass field.

A settings dataclass whose fields are made by :func:`parameter` is the table. From it come the ROS
parameter descriptors, the check of YAML files, the command-line options and the docs' tables.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
import dataclasses
from dataclasses import dataclass
import difflib
import math
from numbers import Integral, Real
from typing import Any, cast, ClassVar, Protocol, TypeAlias, TypeVar

from slam_observer_ros.common.errors import ParameterError, shown

Value: TypeAlias = bool | int | float | str | tuple[float, ...]  # vectors are tuples
Pose6: TypeAlias = tuple[float, float, float, float, float, float]  # x y z, m; roll pitch yaw


class Dataclass(Protocol):
    """What :func:`dataclasses.fields` takes."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


SettingsT = TypeVar('SettingsT', bound=Dataclass)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One row of a parameter table.

    Attributes
    ----------
    name : str
        Name in ROS, in YAML and (with dashes) on the command line.
    default : Value
        Default; its type is the parameter's type.
    description : str
        One sentence for descriptors, help texts and tables.
    minimum, maximum : float
        Inclusive bounds of a number or of every entry of a vector.
    choices : tuple of str
        Allowed values of a string; empty for any.
    read_only : bool
        Whether the value is fixed once the node runs.
    basic : bool
        Whether a robot needs it first; all others are advanced.

    """

    name: str
    default: Value
    description: str
    unit: str = ''
    minimum: float = -math.inf
    maximum: float = math.inf
    choices: tuple[str, ...] = ()
    read_only: bool = True
    basic: bool = False

    def check(self, value: object) -> Value:
        """Return ``value`` in this parameter's type; a ParameterError names it if it can't be."""
        default = self.default
        if isinstance(default, bool):
            self._expect(value, isinstance(value, bool), 'true or false')
            return bool(value)
        if isinstance(default, int):
            is_int = isinstance(value, Integral) and not isinstance(value, bool)
            self._expect(value, is_int, 'an integer')
            return int(self._in_range(cast('int', value)))
        if isinstance(default, float):
            return self._in_range(self._number(value))
        if isinstance(default, str):
            if value is False and 'off' in self.choices:
                value = 'off'  # YAML 1.1 reads off as false
            self._expect(value, isinstance(value, str), 'a string')
            is_choice = not self.choices or value in self.choices
            self._expect(value, is_choice, f'one of {", ".join(self.choices)}')
            return str(value)
        return self._vector(value, len(default))

    def range_text(self) -> str:
        """Return the allowed values as text, empty where anything goes."""
        if self.choices:
            return ' | '.join(self.choices)
        lower = '' if self.minimum == -math.inf else f'≥ {self.minimum:g}'
        upper = '' if self.maximum == math.inf else f'≤ {self.maximum:g}'
        return ', '.join(bound for bound in (lower, upper) if bound)

    def _expect(self, value: object, is_right: bool, expected: str) -> None:
        if not is_right:
            raise ParameterError(f"parameter '{self.name}' takes {expected}, not {shown(value)}")

    def _number(self, value: object) -> float:
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        self._expect(value, is_number, 'a number')
        try:
            number = float(cast('float', value))
        except OverflowError:
            number = math.inf
        self._expect(value, math.isfinite(number), 'a finite number')
        return number

    def _in_range(self, value: float) -> float:
        in_range = self.minimum <= value <= self.maximum
        self._expect(value, in_range, f'a value {self.range_text()}')
        return value

    def _vector(self, value: object, length: int) -> tuple[float, ...]:
        entries = list(value) if isinstance(value, Iterable) and not isinstance(value, str) else []
        self._expect(value, len(entries) == length, f'a list of {length} numbers')
        vector = tuple(self._in_range(self._number(entry)) for entry in entries)
        is_pose = length == len(('x', 'y', 'z', 'roll', 'pitch', 'yaw'))
        if is_pose and max(map(abs, vector[3:])) > 2.0 * math.pi:
            raise ParameterError(
                f"parameter '{self.name}': roll, pitch and yaw are radians, which "
                f'{list(vector[3:])} are not'
            )
        return vector


def parameter(default: Value, description: str, **facts: Any) -> Any:
    """Return a dataclass field that is a row of the table: a :class:`Parameter` of its name.

    ``facts`` are its other attributes; ``choices`` may be a function, if they are not known before
    all modules are there.
    """
    return dataclasses.field(default=default, metadata={'description': description, **facts})


def table(settings_class: type[Dataclass]) -> tuple[Parameter, ...]:
    """Return the parameter table of a settings dataclass, in the order of its fields."""
    return tuple(map(_row, dataclasses.fields(settings_class)))


def _row(field: dataclasses.Field[Any]) -> Parameter:
    row = dict(field.metadata)
    if callable(choices := row.get('choices')):
        row['choices'] = choices()
    return Parameter(name=field.name, default=cast('Value', field.default), **row)


def from_parameters(settings_class: type[SettingsT], values: Mapping[str, object]) -> SettingsT:
    """Return settings built from a mapping of names to values; missing names keep defaults.

    A name that is not in the table, or a value that does not fit it, is a ParameterError.
    """
    rows = {row.name: row for row in table(settings_class)}
    if unknown := sorted(set(values) - set(rows)):
        raise ParameterError(f"unknown parameter '{unknown[0]}'{suggestion(unknown[0], rows)}")
    return settings_class(**{name: rows[name].check(value) for name, value in values.items()})


def checked(settings: SettingsT) -> SettingsT:
    """Return settings that were built in Python, with their values checked as a file's are.

    What does not fit the table, or is no settings, is a ParameterError.
    """
    if not dataclasses.is_dataclass(settings):
        raise ParameterError(f'settings are wanted, not a {type(settings).__name__}')
    return from_parameters(type(settings), dataclasses.asdict(settings))


def changed_names(settings: Dataclass) -> list[str]:
    """Return the names of the settings that differ from their defaults."""
    return [
        row.name for row in table(type(settings)) if getattr(settings, row.name) != row.default
    ]


def suggestion(name: str, names: Collection[str]) -> str:
    """Return the end of a message that asks for the nearest of ``names``; '' if none is near."""
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    return f"; did you mean '{near[0]}'?" if near else ''
