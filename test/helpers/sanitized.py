"""All that is compiled, built anew with sanitizers and called with right and with wrong arguments.

``python test/helpers/sanitized.py ROUNDS`` (``make sanitize``) does so for longer than tests can.
"""

from __future__ import annotations

import importlib.machinery
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
import tempfile

from slam_observer_ros.common.process import digest_of_sources, PACKAGE

CHECKOUT = Path(__file__).resolve().parents[2]
MODULES = ('filter._core', 'smoothing._gauss_newton')

PREAMBLE = """
import importlib.util, sys
for name, library in {libraries!r}:
    spec = importlib.util.spec_from_file_location('slam_observer_ros.' + name, library)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
core, newton = (sys.modules['slam_observer_ros.' + name] for name, _ in {libraries!r})
"""
"""The package takes modules that are there already for its own."""

FUZZ = """
import any_sizes, newton_arguments, step_arguments
print(step_arguments.fuzz(core, 1, {rounds}), newton_arguments.fuzz(newton, 1, {rounds}))
for seed in range({rounds} // 10):
    any_sizes.run(seed)
"""


def why_not() -> str:
    """Say why nothing can be built with sanitizers here; '' if it can."""
    if shutil.which('gcc') is None or not (Path(_include()) / 'Python.h').exists():
        return 'there is no gcc, or no headers of Python'
    return '' if Path(_sanitizer()).is_absolute() else 'gcc has no address sanitizer here'


def fuzz(folder: Path, rounds: int) -> tuple[int, int]:
    """Build into a folder; return how many calls of each module were refused in some rounds.

    Each round calls every function with right and with wrong arguments; every tenth runs an
    estimator whose state has any size. All that sanitizers find fails.
    """
    libraries = [(name, str(_built(name, folder))) for name in MODULES]
    code = PREAMBLE.format(libraries=libraries) + FUZZ.format(rounds=rounds)
    paths = [str(CHECKOUT), str(CHECKOUT / 'test' / 'helpers'), os.environ.get('PYTHONPATH', '')]
    environment = {
        **os.environ,
        'LD_PRELOAD': _sanitizer(),
        'ASAN_OPTIONS': 'detect_leaks=0',
        'PYTHONPATH': os.pathsep.join(paths),
        'PYTHONMALLOC': 'malloc',  # else Python's own arenas hide what is out of bounds
    }
    run = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr[-3000:]
    of_core, of_newton = run.stdout.split()
    return int(of_core), int(of_newton)


def _built(name: str, folder: Path) -> Path:
    source = (PACKAGE / name.replace('.', '/')).with_suffix('.c')
    library = folder / f'{source.stem}{importlib.machinery.EXTENSION_SUFFIXES[0]}'
    flags = ['-O0', '-g', '-fPIC', '-shared', f'-DSOURCES={digest_of_sources(name)}']
    flags += ['-fsanitize=address,undefined', '-fno-sanitize-recover=all']
    subprocess.run(
        ['gcc', *flags, f'-I{_include()}', str(source), '-o', str(library), '-lm'], check=True
    )
    return library


def _include() -> str:
    return sysconfig.get_paths()['include']


def _sanitizer() -> str:
    return subprocess.run(
        ['gcc', '-print-file-name=libasan.so'], capture_output=True, text=True, check=True
    ).stdout.strip()


if __name__ == '__main__':
    if why_not():
        sys.exit(why_not())
    with tempfile.TemporaryDirectory() as made:
        found = fuzz(Path(made), int(sys.argv[1]))
    sys.stdout.write(f'sanitizers found nothing; calls refused: {found}\n')
