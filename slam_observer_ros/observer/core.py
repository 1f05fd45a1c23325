"""The usual step by the compiled core where it was built, and else by its reference in numpy."""

from __future__ import annotations

from importlib import import_module
import os
from types import ModuleType

from slam_observer_ros.observer import step

VARIABLE = 'SLAM_OBSERVER_CORE'
"""Environment variable that chooses the reference where it is ``numpy``."""


def _compiled() -> ModuleType | None:
    """Return the compiled core; None where it was not built, or is not to be used."""
    if os.environ.get(VARIABLE) == 'numpy':
        return None
    try:
        return import_module('slam_observer_ros.observer._core')
    except ImportError:  # there was no compiler
        return None


COMPILED = _compiled()


def description() -> str:
    """Say which of the two it is, and why."""
    if COMPILED is not None:
        return 'C'
    if os.environ.get(VARIABLE) == 'numpy':
        return f'numpy, as {VARIABLE} says'
    return 'numpy, three times slower: no C compiler or Python headers when this was installed'


advance = step.advance if COMPILED is None else COMPILED.advance
observe = step.observe if COMPILED is None else COMPILED.observe
