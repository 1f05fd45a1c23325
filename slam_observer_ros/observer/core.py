"""The usual step by the compiled core where it was built, and else by its reference in numpy."""

from __future__ import annotations

from importlib import import_module
import os
from types import ModuleType

from slam_observer_ros.observer import step

VARIABLE = 'SLAM_OBSERVER_CORE'
"""Environment variable that chooses the reference where it is ``numpy``."""


def compiled(name: str) -> ModuleType | None:
    """Return a compiled module of the package; None where it was not built, or is not to be used.

    Of any two that were built together either both are there or none.
    """
    if os.environ.get(VARIABLE) == 'numpy':
        return None
    try:
        return import_module(f'slam_observer_ros.{name}')
    except ImportError:  # there was no compiler
        return None


COMPILED = compiled('observer._core')


def description() -> str:
    """Say which of the two it is, and why."""
    if COMPILED is not None:
        return 'C'
    if os.environ.get(VARIABLE) == 'numpy':
        return f'numpy, as {VARIABLE} says'
    return 'numpy, three times slower: no C compiler or Python headers when this was installed'


advance = step.advance if COMPILED is None else COMPILED.advance
observe = step.observe if COMPILED is None else COMPILED.observe
