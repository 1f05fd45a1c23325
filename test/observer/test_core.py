"""The compiled core does to the bit of rounding what the reference does, and refuses the rest."""

from __future__ import annotations

from copy import deepcopy
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
import sanitized
import step_arguments

from slam_observer_ros.observer import core, step

ROUNDING = 1e-12
SOURCE = Path(core.__file__).with_name('_core.c')


@pytest.fixture(name='compiled')
def fixture_compiled():
    if core.COMPILED is None:
        pytest.skip('the core was not compiled, or is not to be used')
    return core.COMPILED


def assert_same(one, other, what):
    for of_one, of_other in zip(one, other, strict=True):
        if of_one is None or not isinstance(of_one, tuple):
            continue
        for name, a, b in zip(type(of_one)._fields, of_one, of_other, strict=True):
            if not isinstance(a, np.ndarray) or a.dtype == np.bool_:
                continue
            finite = np.isfinite(b)
            np.testing.assert_array_equal(np.isfinite(a), finite, err_msg=name)
            scale = max(float(np.abs(b[finite]).max(initial=0.0)), 1e-6)
            off = float(np.abs(a[finite] - b[finite]).max(initial=0.0)) / scale
            assert off <= ROUNDING, f'{what}: {name} is off by {off:.1e}'


@pytest.mark.parametrize('kind', ['motion', 'observation'])
def test_each_step_is_that_of_the_reference(compiled, kind):
    make = getattr(step_arguments, f'random_{kind}')
    name = {'motion': 'advance', 'observation': 'observe'}[kind]
    done = 0
    for seed in range(300):
        arguments = make(np.random.default_rng(seed))
        before, other = deepcopy(arguments), deepcopy(arguments)
        status = getattr(compiled, name)(*arguments)
        assert status == getattr(step, name)(*other), seed
        if status == step.UNUSUAL:
            # All but what it writes is as it was.
            assert_same(arguments[:-1], before[:-1], seed)
            assert_same(other[:-1], before[:-1], seed)
        else:
            done += 1
            assert_same(arguments, other, f'{kind} {seed}')
    assert done >= 100


def test_wrong_arguments_are_refused_and_do_not_crash(compiled):
    assert step_arguments.fuzz(compiled, 0, 300) >= 100


def test_numpy_can_be_asked_for():
    code = 'from slam_observer_ros.observer import core; print(core.COMPILED, core.description())'
    environment = {**os.environ, core.VARIABLE: 'numpy'}
    run = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=True
    )
    assert run.stdout == f'None numpy, as {core.VARIABLE} says\n'


def test_sanitizers_find_nothing(tmp_path):
    """Built to look for reads and writes out of bounds, and for undefined behaviour."""
    assert sanitized.refused(SOURCE, 'step_arguments', tmp_path) >= 50
