"""What is compiled, where it was built; each of these modules has a reference in numpy."""

from __future__ import annotations

from importlib import import_module
import os
from types import ModuleType

VARIABLE = 'SLAM_OBSERVER_CORE'
"""Environment variable that chooses the references where it is ``numpy``."""


def compiled(name: str) -> ModuleType | None:
    """Return a compiled module; None where it was not built, or is not to be used."""
    if os.environ.get(VARIABLE) == 'numpy':
        return None
    try:
        return import_module(f'slam_observer_ros.{name}')
    except ImportError:  # there was no compiler
        return None
