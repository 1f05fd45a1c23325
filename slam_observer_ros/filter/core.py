"""The usual step by the compiled core where it was built, and else by its reference in numpy."""

from __future__ import annotations

import os

from slam_observer_ros.common.process import compiled, VARIABLE
from slam_observer_ros.filter import step

COMPILED = compiled('filter._core')


def description() -> str:
    """Say which of the two it is, and why."""
    if COMPILED is not None:
        return 'C'
    if os.environ.get(VARIABLE) == 'numpy':
        return f'numpy, as {VARIABLE} says'
    return 'numpy, three times slower: the core was not compiled, or from other sources'


advance = step.advance if COMPILED is None else COMPILED.advance
observe = step.observe if COMPILED is None else COMPILED.observe
