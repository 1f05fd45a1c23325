"""What is compiled where it was built: each of these modules has a reference in numpy."""

from __future__ import annotations

from importlib import import_module
import os
from pathlib import Path
from types import ModuleType
import warnings
import zlib

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
    headers = sorted((PACKAGE / 'filter').glob('_*.h'))
    return zlib.crc32(b''.join(path.read_bytes() for path in (source, *headers)))
