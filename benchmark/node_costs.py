"""What the live node costs, beside nodes that do nothing with the same messages.

Twist at 50 Hz and clouds of 20 landmarks at 20 Hz go over DDS to one process after the other: a
subscriber that drops them, a node that publishes each of them again, and the observer. CPU time is
the whole process's, by the kernel. Latency is from before a Twist is published here to the
reception here of what comes of it: its echo, or the first odometry that is not older. Nothing
outside hears of it: the domain is one that nobody has, on this machine alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import os
from pathlib import Path
import signal
import socket
from statistics import median
import subprocess
import sys
import time

from cost_tables import Table, Tables
import numpy as np
import worlds

TWIST_HZ, LANDMARKS_HZ, TICK_HZ = 50, 20, 100
POINTS = 20
VELOCITY = np.array([0.0, 0.0, 0.1, 0.5, 0.0, 0.0])
TURNS = 2
WARM_UP_S, MEASURED_S, IDLE_S = 1.0, 6.0, 3.0
PATIENCE_S = 20.0  # for a node to appear or to end
DOMAIN_IDS = range(1, 102)  # as test/conftest.py takes them

OBSERVER, ALL_READ = 'observer_node', 'observer_node, all its topics read'
BARE, ECHO, EVENTS_ECHO = 'bare subscriber', 'echo node', 'echo node, EventsExecutor'

SUBJECT = [sys.executable, str(Path(__file__).with_name('node_subjects.py'))]
NODE = [sys.executable, '-m', 'slam_observer_ros.nodes.executables', 'observer_node', '--ros-args']
# Held back for nothing: the order is right, and the code is to be measured, not the wait.
NODE += ['-p', 'reorder_window:=0.0']
COMMANDS = {
    BARE: [*SUBJECT, 'bare'],
    ECHO: [*SUBJECT, 'echo'],
    EVENTS_ECHO: [*SUBJECT, 'echo', 'events'],
    OBSERVER: NODE,
    ALL_READ: NODE,
}

COLUMNS = ('CPU', 'latency', 'its 95 %', 'CPU while idle', 'CPU, % of a core', 'latency, ms')


@dataclass(frozen=True, slots=True)
class Cost:
    """Of one process: shares of a core while fed and while idle, and latencies, seconds."""

    cpu: float
    idle: float
    latencies_s: list[float]

    @property
    def p50_s(self) -> float:
        """Median latency, seconds; NaN where nothing comes back."""
        return float(np.median(self.latencies_s)) if self.latencies_s else np.nan

    @property
    def p95_s(self) -> float:
        """Latency that one in twenty exceeds, seconds."""
        return float(np.quantile(self.latencies_s, 0.95)) if self.latencies_s else np.nan


def measure_node() -> Tables:
    """Return costs of the nodes as multiples of the echo node's, which is spun as nodes are."""
    with own_domain():
        runs: dict[str, list[Cost]] = {name: [] for name in COMMANDS}
        for _ in range(TURNS):
            for name, costs in runs.items():
                costs.append(measure(name))

    def of(name: str, figure: Callable[[Cost], float]) -> float:
        return median(figure(cost) for cost in runs[name])

    figures: tuple[Callable[[Cost], float], ...] = (
        lambda cost: cost.cpu,
        lambda cost: cost.p50_s,
        lambda cost: cost.p95_s,
        lambda cost: cost.idle,
    )
    rows: dict[str, list[float | None]] = {}
    for name in COMMANDS:
        row = [of(name, figure) / of(ECHO, figure) for figure in figures]
        row += [100.0 * of(name, figures[0]), 1e3 * of(name, figures[1])]
        rows[name] = [None if np.isnan(value) else value for value in row]
    columns = [
        'CPU',
        'latency, median',
        '95 %',
        'CPU while idle',
        'CPU, % of a core',
        'median, ms',
    ]
    return {'node': Table(columns=columns, rows=rows)}


def measure(name: str) -> Cost:
    """Run a node and feed it."""
    from node_driver import Driver

    with process(COMMANDS[name]) as subject, Driver(reads_all=name == ALL_READ) as driver:
        driver.wait_for_subscribers(PATIENCE_S)
        driver.rest(WARM_UP_S)
        idle_s = cpu_s(subject.pid)
        driver.rest(IDLE_S)
        idle_s = cpu_s(subject.pid) - idle_s
        driver.feed(WARM_UP_S)
        driver.rest(0.2)
        driver.forget()
        busy_s, begin_s = cpu_s(subject.pid), time.monotonic()
        driver.feed(MEASURED_S)
        busy_s = (cpu_s(subject.pid) - busy_s) / (time.monotonic() - begin_s)
        driver.rest(0.2)
        return Cost(busy_s, idle_s / IDLE_S, driver.latencies_s())


def cpu_s(process_id: int) -> float:
    """Return the CPU time that a process has taken so far, seconds, of all its threads."""
    threads = Path(f'/proc/{process_id}/task').glob('*/schedstat')
    return 1e-9 * sum(int(thread.read_text().split()[0]) for thread in threads)


@contextmanager
def process(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program of this checkout, and end it."""
    path = os.pathsep.join([str(worlds.CHECKOUT), os.environ.get('PYTHONPATH', '')])
    started = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, 'PYTHONPATH': path},
    )
    try:
        yield started
    finally:
        started.send_signal(signal.SIGINT)
        try:
            started.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            started.kill()
            started.wait()


@contextmanager
def own_domain() -> Iterator[None]:
    """Give what is started within a ROS domain that no other benchmark or test has."""
    before = dict(os.environ)
    with socket.socket(socket.AF_UNIX) as reservation:
        domain_id = next(i for i in DOMAIN_IDS if _reserve(reservation, i))
        os.environ |= {
            'ROS_DOMAIN_ID': str(domain_id),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            # Shared memory would be left behind by a node that has to be killed.
            'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
        }
        try:
            yield
        finally:
            _restore(before)


def _reserve(reservation: socket.socket, domain_id: int) -> bool:
    """Bind an abstract socket, which the kernel frees even if this process is killed."""
    try:
        reservation.bind(f'\0slam_observer_ros_domain_{domain_id}')
    except OSError:
        return False
    return True


def _restore(environment: Mapping[str, str]) -> None:
    os.environ.clear()
    os.environ.update(environment)
