"""How many threads a program's matrix products take."""

from __future__ import annotations

import os

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
