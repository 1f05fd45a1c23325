"""What whole programs cost: replay, start-up, and the memory that a landmark takes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import resource
from statistics import median
import subprocess
import sys
import tempfile

from cost_tables import Table, Tables
from estimators import EKF
from step_costs import drive, ESTIMATORS, make, settings_for
import worlds

TURNS = 5
CONFIG = ['--config', 'mrclam']  # that of docs/gallery.md for its recording
LONGEST_S = 300.0
FEW, MANY, SEEN = 10, 1000, 10  # landmarks, for the memory of one
LARGE_MAPS = (1000, 5000, 10_000)  # for the memory of all, with Riccati gains
COMMAND = [sys.executable, '-m', 'slam_observer_ros.cli.main']

READ = """\
import sys
from pathlib import Path
from rosbags.highlevel import AnyReader
with AnyReader([Path(sys.argv[1])]) as reader:
    for connection, _, raw in reader.messages():
        reader.deserialize(raw, connection.msgtype)
"""
"""What it takes to read a recording."""


def measure_replay() -> Tables:
    """Return the CPU time of ``replay --json`` over the time to read the same recording."""
    with with_bytecode() as folder:
        recording = Path(folder) / 'robot1.mcap'
        data = worlds.data_folder() / 'mrclam' / 'MRCLAM_Dataset6'
        run([*COMMAND, 'convert', 'mrclam', '--robot', '1', str(data), str(recording)])
        replay = [*COMMAND, 'replay', str(recording), '--json']
        read = [sys.executable, '-c', READ, str(recording)]
        turns = take_turns(read, [*replay, *CONFIG], replay)
    read_s = median(turn[0] for turn in turns)
    rows: dict[str, list[float | None]] = {
        f'MRCLAM 6, robot 1, `{" ".join(CONFIG)}`': [over_first(turns, 1), read_s],
        'MRCLAM 6, robot 1, defaults': [over_first(turns, 2), read_s],
    }
    return {'replay': Table(columns=['replay --json over read', 'read, s'], rows=rows)}


def measure_start() -> Tables:
    """Return the CPU time of ``slam-observer --help`` over the time to import numpy."""
    with with_bytecode():
        turns = take_turns([sys.executable, '-c', 'import numpy'], [*COMMAND, '--help'])
    rows: dict[str, list[float | None]] = {'slam-observer --help': [over_first(turns, 1)]}
    return {'start': Table(columns=['over import numpy'], rows=rows)}


def measure_memory() -> Tables:
    """Return how much memory a landmark takes at most while the robot drives past the others."""
    grown_kb = {name: (peak_kb(name, MANY) - peak_kb(name, FEW)) / MANY for name in ESTIMATORS}
    rows: dict[str, list[float | None]] = {
        name: [value_kb, value_kb / grown_kb[EKF]] for name, value_kb in grown_kb.items()
    }
    of_few_kb = peak_kb('riccati', FEW)
    large: dict[str, list[float | None]] = {
        'riccati': [1e-6 * (peak_kb('riccati', known) - of_few_kb) for known in LARGE_MAPS]
    }
    return {
        'memory': Table(columns=['kB', f'over the {EKF}'], rows=rows),
        'memory_large': Table(columns=[f'n = {known}' for known in LARGE_MAPS], rows=large),
    }


def take_turns(*commands: list[str]) -> list[list[float]]:
    """Return the CPU times of programs that are run in turns, seconds: a list for each turn."""
    turns = [[cpu_s(command) for command in commands] for _ in range(TURNS + 1)]
    return turns[1:]  # without the first, which may write bytecode


@contextmanager
def with_bytecode() -> Iterator[str]:
    """Let programs keep their bytecode, as installed ones have it, in a folder that is given."""
    before = dict(os.environ)
    with tempfile.TemporaryDirectory() as folder:
        os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
        os.environ['PYTHONPYCACHEPREFIX'] = str(Path(folder) / 'bytecode')
        try:
            yield folder
        finally:
            os.environ.clear()
            os.environ.update(before)


def over_first(turns: list[list[float]], number: int) -> float:
    """Return the median over the turns of one time over the first."""
    return median(turn[number] / turn[0] for turn in turns)


def cpu_s(command: list[str]) -> float:
    """Run a program to its end; return the CPU time of it and its children, seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run(command)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def peak_kb(name: str, known: int) -> float:
    """Return the most memory that a process has with an estimator of so many landmarks."""
    return float(run([sys.executable, __file__, name, str(known)]))


def run(command: list[str]) -> str:
    """Run a program of this checkout, which must succeed in time; return its output."""
    path = os.pathsep.join([str(worlds.CHECKOUT), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        command,
        check=True,
        timeout=LONGEST_S,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=worlds.CHECKOUT,
        env={**os.environ, 'PYTHONPATH': path},
    )
    return done.stdout


def _print_peak(name: str, known: int) -> None:
    estimator = make(name, settings_for(known))
    start, steps = drive(known, SEEN)
    for step in (start, *steps):
        for event in step:
            estimator.add(event)
    # Not of resource: that has the peak of the process, too, that this one was forked from.
    lines = Path('/proc/self/status').read_text(encoding='utf-8').splitlines()
    sys.stdout.write(next(line.split()[1] for line in lines if line.startswith('VmHWM')))


if __name__ == '__main__':
    _print_peak(sys.argv[1], int(sys.argv[2]))
