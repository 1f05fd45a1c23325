"""The message types that are read, and as what: decoders in ``messages/`` register them.

This lies below the decoders as parameters offer the types, which are listed nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Literal, TypeAlias

Role: TypeAlias = Literal['velocity', 'angular velocity', 'landmarks', 'pose']

_PACKAGE = 'slam_observer_ros.messages'


@dataclass(frozen=True, slots=True)
class MessageType:
    """A type that is read, as ROS 2 names it, and what decodes it.

    Attributes
    ----------
    package : str
        What publishes it, as documents name that; empty for many.
    definition : str
        Its fields, those of nested types behind them as in recordings; empty for those of ROS's
        common interfaces. Recordings that define it otherwise are refused.
    is_ambiguous : bool
        Whether it may hold other things, too: it is only taken where the user names type or topic.

    """

    name: str
    role: Role
    decode: Callable[..., Any]
    module: str
    package: str = ''
    definition: str = ''
    is_ambiguous: bool = False

    @property
    def short_name(self) -> str:
        """Name without package, as parameters have it."""
        return self.name.rpartition('/')[2]


_REGISTERED: dict[tuple[Role, str], MessageType] = {}


def register(message_type: MessageType) -> None:
    """Add a type; ValueError if another decoder reads the same of it."""
    key = message_type.role, message_type.name
    if key in _REGISTERED:
        raise ValueError(f'{message_type.name} is read by {_REGISTERED[key].module} already')
    _REGISTERED[key] = message_type


def message_types(role: Role) -> dict[str, MessageType]:
    """Return the types that are read, or a part of them, by name.

    Where a live topic carries several the first is taken: they are in the order of the decoders'
    modules, and in these as they are written.
    """
    _import_decoders()
    ordered = sorted(_REGISTERED.values(), key=lambda message_type: message_type.module)
    return {known.name: known for known in ordered if known.role == role}


def short_names(role: Role, is_ambiguous: bool | None = None) -> tuple[str, ...]:
    """Return the names of the same types as parameters have them, or only of some."""
    types = message_types(role).values()
    some = [known for known in types if is_ambiguous in (None, known.is_ambiguous)]
    return tuple(dict.fromkeys(known.short_name for known in some))


@cache
def _import_decoders() -> None:
    for module in iter_modules(import_module(_PACKAGE).__path__):
        import_module(f'{_PACKAGE}.{module.name}')
