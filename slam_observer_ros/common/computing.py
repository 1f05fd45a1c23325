"""With what numbers are computed: how many threads, and what is compiled where it was built."""

from __future__ import annotations

from importlib import import_module
import os
from types import ModuleType

CHOICES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'BLIS_NUM_THREADS')
"""Environment variables by which a user says how many there shall be."""


def use_one_thread() -> None:
    """Let numpy and SciPy compute in one thread, unless the environment says more.

    They look once, as they are loaded: call this before. The matrices are small: several threads
    wait for each other longer than they compute, up to ten times on a busy machine, and take the
    processor from the robot's other programs.
    """
    if not any(name in os.environ for name in CHOICES):
        os.environ.update(dict.fromkeys(CHOICES, '1'))


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
