"""With what numbers are computed: how many threads, and what is compiled where it was built."""

from __future__ import annotations

from importlib import import_module
import os
from pathlib import Path
from types import ModuleType
import warnings
import zlib

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

PACKAGE = Path(__file__).parents[1]


def compiled(name: str) -> ModuleType | None:
    """Return a compiled module; None where it was not built, or is not to be used."""
    if os.environ.get(VARIABLE) == 'numpy':
        return None
    try:
        module = import_module(f'slam_observer_ros.{name}')
    except ImportError:  # there was no compiler
        return None
    if digest_of_sources(name) in (None, getattr(module, 'SOURCES', 0)):
        return module
    warnings.warn(
        f'{module.__file__} was built from other sources than there are now, and numpy takes its '
        'place: build it by `make`, or `python setup.py build_ext --inplace`',
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def digest_of_sources(name: str) -> int | None:
    """Return a number that changes with the sources of a module; None where they are not."""
    source = (PACKAGE / name.replace('.', '/')).with_suffix('.c')
    if not source.exists():
        return None
    headers = sorted((PACKAGE / 'observer').glob('_*.h'))
    return zlib.crc32(b''.join(path.read_bytes() for path in (source, *headers)))
