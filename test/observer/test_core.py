"""The compiled core does to the bit of rounding what the reference does, and refuses the rest."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
import importlib.machinery
import importlib.util
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig

import numpy as np
import pytest
import step_arguments

from slam_observer_ros.observer import core, step

ROUNDING = 1e-12
CHECKOUT = Path(__file__).resolve().parents[2]
SOURCE = CHECKOUT / 'slam_observer_ros' / 'observer' / '_core.c'


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
    counts = Counter()
    for seed in range(300):
        arguments = make(np.random.default_rng(seed))
        before, other = deepcopy(arguments), deepcopy(arguments)
        status = getattr(compiled, name)(*arguments)
        assert status == getattr(step, name)(*other), seed
        counts[status] += 1
        if status != step.UNUSUAL:
            parts = slice(None) if status != step.REJECTS else slice(-1)
            assert_same(arguments[parts], other[parts], f'{kind} {seed}')
        if status == step.REJECTS:
            for part in ('weights', 'r', 'judged'):
                one, two = (getattr(of[-1], part) for of in (arguments, other))
                np.testing.assert_allclose(one, two, rtol=1e-9, err_msg=part)
        if status in (step.UNUSUAL, step.REJECTS):
            # All but what it writes is as it was; of rejected points something is learnt.
            kept = slice(-1) if status == step.UNUSUAL else slice(-2)
            assert_same(arguments[kept], before[kept], seed)
            assert_same(other[kept], before[kept], seed)
    assert counts[step.DONE] + counts[step.AT_REST] >= 100
    assert counts[step.REJECTS] >= 10 or kind == 'motion'


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
    compiler = shutil.which('gcc')
    include = sysconfig.get_paths()['include']
    if compiler is None or not (Path(include) / 'Python.h').exists():
        pytest.skip('there is no gcc, or no headers of Python')
    sanitizer = subprocess.run(
        [compiler, '-print-file-name=libasan.so'], capture_output=True, text=True, check=True
    ).stdout.strip()
    if not Path(sanitizer).is_absolute():
        pytest.skip('gcc has no address sanitizer here')
    library = tmp_path / f'_core{importlib.machinery.EXTENSION_SUFFIXES[0]}'
    flags = ['-O1', '-g', '-fPIC', '-shared', '-fsanitize=address,undefined']
    flags += ['-fno-sanitize-recover=all']
    subprocess.run(
        [compiler, *flags, f'-I{include}', str(SOURCE), '-o', str(library), '-lm'], check=True
    )
    code = (
        'import importlib.util, step_arguments\n'
        f'spec = importlib.util.spec_from_file_location("_core", {str(library)!r})\n'
        'core = importlib.util.module_from_spec(spec)\n'
        'spec.loader.exec_module(core)\n'
        'print(step_arguments.fuzz(core, 1, 200))\n'
    )
    paths = [str(CHECKOUT), str(CHECKOUT / 'test' / 'helpers'), os.environ.get('PYTHONPATH', '')]
    environment = {
        **os.environ,
        'LD_PRELOAD': sanitizer,
        'ASAN_OPTIONS': 'detect_leaks=0',
        'PYTHONPATH': os.pathsep.join(paths),
        'PYTHONMALLOC': 'malloc',  # else Python's own arenas hide what is out of bounds
    }
    run = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert int(run.stdout) >= 50
