"""A compiled module, built anew with sanitizers and called with right and with wrong arguments."""

from __future__ import annotations

import importlib.machinery
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]


def refused(source, arguments, folder):
    """Return how many of 200 rounds of ``arguments``.fuzz were refused by the module.

    ``arguments`` is the name of a module of these helpers; what is built goes into a folder.
    """
    compiler = shutil.which('gcc')
    include = sysconfig.get_paths()['include']
    if compiler is None or not (Path(include) / 'Python.h').exists():
        pytest.skip('there is no gcc, or no headers of Python')
    sanitizer = subprocess.run(
        [compiler, '-print-file-name=libasan.so'], capture_output=True, text=True, check=True
    ).stdout.strip()
    if not Path(sanitizer).is_absolute():
        pytest.skip('gcc has no address sanitizer here')
    name = source.stem
    library = folder / f'{name}{importlib.machinery.EXTENSION_SUFFIXES[0]}'
    flags = ['-O0', '-g', '-fPIC', '-shared', '-DSOURCES=0', '-fsanitize=address,undefined']
    flags += ['-fno-sanitize-recover=all']
    subprocess.run(
        [compiler, *flags, f'-I{include}', str(source), '-o', str(library), '-lm'], check=True
    )
    code = (
        f'import importlib.util, {arguments}\n'
        f'spec = importlib.util.spec_from_file_location({name!r}, {str(library)!r})\n'
        'compiled = importlib.util.module_from_spec(spec)\n'
        'spec.loader.exec_module(compiled)\n'
        f'print({arguments}.fuzz(compiled, 1, 200))\n'
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
    return int(run.stdout)
