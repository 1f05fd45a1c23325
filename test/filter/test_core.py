"""The compiled core does to the bit of rounding what the reference does, and refuses the rest."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
from rounding import off_by
import step_arguments

from slam_observer_ros.filter import core, step

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
            off = off_by(a[finite], b[finite], 1e-6)
            assert off <= ROUNDING, f'{what}: {name} is off by {off:.1e}'


@pytest.mark.parametrize('kind', ['motion', 'observation'])
def test_each_step_is_that_of_the_reference(compiled, kind):
    make = getattr(step_arguments, f'random_{kind}')
    name = {'motion': 'advance', 'observation': 'observe'}[kind]
    counts = Counter()
    for seed in range(300):
        arguments = make(np.random.default_rng(seed))
        before, other = deepcopy(arguments), deepcopy(arguments)
        status = getattr(compiled, name)(*arguments)
        counts[status] += 1
        if status == step.UNUSUAL:  # numpy does gaps, and mends what rounding did
            assert_same(arguments[:-1], before[:-1], seed)
            continue
        assert status == getattr(step, name)(*other), seed
        parts = slice(None) if status != step.REJECTS else slice(-1)
        assert_same(arguments[parts], other[parts], f'{kind} {seed}')
        if status == step.REJECTS:  # all but what it writes is as it was
            assert_same(arguments[:-1], before[:-1], seed)
            assert_same(other[:-1], before[:-1], seed)
    assert counts[step.DONE] + counts[step.AT_REST] >= 100
    assert counts[step.REJECTS] >= 10 or kind == 'motion'
    assert counts[step.UNUSUAL] <= 30 or kind == 'motion'


def test_wrong_arguments_are_refused_and_do_not_crash(compiled):
    assert step_arguments.fuzz(compiled, 0, 300) >= 100


def test_numpy_can_be_asked_for():
    code = (
        'from slam_observer_ros.filter import core\n'
        'from slam_observer_ros.smoothing import bordered_chain\n'
        'print(core.COMPILED, bordered_chain.COMPILED, core.description())'
    )
    environment = {**os.environ, core.VARIABLE: 'numpy'}
    run = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=True
    )
    assert run.stdout == f'None None numpy, as {core.VARIABLE} says\n'


def test_any_number_of_calibrated_sensors_is_used(compiled):
    """Seven cameras with an estimated mount are 62 states, more than a fixed room once had."""
    by_count = {}
    for seed in range(60):
        arguments = step_arguments.random_observation(np.random.default_rng(seed))
        by_count[len(arguments[0].drift)] = compiled.observe(*arguments)
    assert max(by_count) > 58
    assert {status for count, status in by_count.items() if count > 58} & {step.DONE}


def test_no_code_runs_between_a_check_and_its_use(compiled):
    """A number's conversion could else change rows that were found to be in bounds."""
    x, landmarks, seen, figures, *others = step_arguments.random_observation(
        np.random.default_rng(3)
    )

    class Number:
        def __float__(self):
            seen.rows[:] = 2**40
            return 1e-3

    with pytest.raises(ValueError, match='PointFigures'):
        compiled.observe(x, landmarks, seen, (Number(), *figures[1:]), *others)
    assert (seen.rows < 2**40).all()
