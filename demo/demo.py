"""``make demo``: simulator and observer as two processes, watched until they have converged.

Leaves the paper's figures 3 and 4, drawn from the messages that came over DDS, and a recording of
all topics in ``demo_output/run_N``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, ExitStack, suppress
import math
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import TypeAlias

from demo_listener import DemoListener
from demo_report import report
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from slam_observer_ros.common.errors import SlamObserverError
from slam_observer_ros.common.process import StopSignal
from slam_observer_ros.recordings.writer import RecordingWriter

NodeContext: TypeAlias = AbstractContextManager['subprocess.Popen[bytes]']

MESSAGE_RATE_HZ = 20.0
PUBLISH_RATE_HZ = 100.0

INITIAL_BIAS_M = 1.5
"""Large, so that the transient can be seen in the picture."""

QUEUE_DEPTH = 10_000
"""More than the simulator sends, so that an observer on a slow machine falls behind, no more."""

LANDMARKS_MAX_WAIT_S = 60.0
"""Long, for the same reason: landmarks that have waited are used."""

LATE_LIMIT_S = 2.0
"""For so long a busy machine may hold the observer up, in real time."""

STALL_LIMIT_S = 30.0
LAST_MESSAGES_S = 0.5
STOP_LIMIT_S = 10.0


class DemoError(SlamObserverError):
    """The demo can't run or did not reach its end."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; return 0 if the observer converged."""
    options = _parser().parse_args(args)
    console = Console(highlight=False)
    # Other machines' robots are none of the demo's business.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        folder = _new_folder(options.output)
        console.print(
            f'simulating {options.duration:g} s at {options.real_time_factor:g} times real time'
        )
        with RecordingWriter(folder / 'recording.mcap') as writer:
            listener = _run(options, folder, writer, console)
        return 0 if report(listener, folder, console) else 1
    except SlamObserverError as error:
        console.print(f'demo: {error}', style='red', markup=False)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='demo', description=(__doc__ or '').splitlines()[0])
    parser.add_argument(
        '--duration', type=_positive, default=80.0, help='simulated seconds (default 80)'
    )
    parser.add_argument(
        '--real-time-factor',
        type=_positive,
        default=4.0,
        help='simulated seconds a second (default 4)',
    )
    parser.add_argument(
        '--output',
        type=Path,
        default=Path('demo_output'),
        help='folder in which run_N is made (default demo_output)',
    )
    return parser


def _positive(text: str) -> float:
    with suppress(ValueError):
        if 0.0 < (number := float(text)) < math.inf:
            return number
    raise argparse.ArgumentTypeError(f'{text} is no number above zero')


def _new_folder(parent: Path) -> Path:
    """Make and return the first run_N that does not exist yet."""
    number = 1
    while True:
        folder = parent / f'run_{number}'
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            number += 1
        except OSError as error:
            raise DemoError(f"can't make {folder}: {error.strerror}") from error
        else:
            return folder


def _run(
    options: argparse.Namespace, folder: Path, writer: RecordingWriter, console: Console
) -> DemoListener:
    """Start both nodes, listen until the simulation is over, stop them."""
    stop = StopSignal()
    stop.begin()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    with ExitStack() as cleanup:
        cleanup.callback(rclpy.try_shutdown)
        listener = DemoListener(writer, _is_simulated_time(options))
        cleanup.callback(listener.destroy_node)
        executor = SingleThreadedExecutor()
        executor.add_node(listener)
        cleanup.callback(executor.shutdown)
        cleanup.enter_context(_observer(options, folder))
        _wait_for_observer(executor, listener, stop)
        simulator = cleanup.enter_context(_simulator(options, folder))
        _listen(executor, listener, simulator, stop, options.duration, console)
    return listener


def _is_simulated_time(options: argparse.Namespace) -> bool:
    return bool(options.real_time_factor != 1.0)


def _observer(options: argparse.Namespace, folder: Path) -> NodeContext:
    reliable = {
        f'qos_overrides./{topic}.subscription.{policy}': value
        for topic in ('twist', 'landmarks')
        for policy, value in (('reliability', 'reliable'), ('depth', QUEUE_DEPTH))
    }
    return _node(
        'observer_node',
        folder,
        gains='constant',
        velocity_type='TwistStamped',
        landmarks_type='PointCloud2',
        **reliable,
        landmarks_max_wait=LANDMARKS_MAX_WAIT_S,
        late_limit=min(60.0, LATE_LIMIT_S * max(1.0, options.real_time_factor)),
        publish_rate=PUBLISH_RATE_HZ,
        use_sim_time=_is_simulated_time(options),
    )


def _simulator(options: argparse.Namespace, folder: Path) -> NodeContext:
    return _node(
        'simulator_node',
        folder,
        stamped=True,
        landmarks_type='PointCloud2',
        velocity_rate=MESSAGE_RATE_HZ,
        observation_rate=MESSAGE_RATE_HZ,
        initial_bias=INITIAL_BIAS_M,
        duration=options.duration,
        real_time_factor=options.real_time_factor,
        wait_for_subscribers=2,
    )


@contextmanager
def _node(name: str, folder: Path, **parameters: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node with its output in a file; stop it at the end."""
    command = [sys.executable, '-m', 'slam_observer_ros.nodes.executables', name, '--ros-args']
    for key, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        command += ['-p', f'{key}:={text}']
    log = folder / f'{name}.log'
    with log.open('wb') as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        exit_code = _end(process)
    if exit_code != 0:
        raise DemoError(f'{name} has failed with exit code {exit_code}; see {log}')


def _end(process: subprocess.Popen[bytes]) -> int:
    """Stop a process if it still runs; return its exit code."""
    process.terminate()
    try:
        return process.wait(STOP_LIMIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _wait_for_observer(
    executor: SingleThreadedExecutor, listener: DemoListener, stop: StopSignal
) -> None:
    limit_s = time.monotonic() + STALL_LIMIT_S
    while not listener.hears_observer():
        _check(listener, stop, limit_s)
        executor.spin_once(timeout_sec=0.1)


def _listen(
    executor: SingleThreadedExecutor,
    listener: DemoListener,
    simulator: subprocess.Popen[bytes],
    stop: StopSignal,
    duration_s: float,
    console: Console,
) -> None:
    """Show how far the run is until the simulator ends and the observer has caught up."""
    columns = (
        TextColumn('{task.description}'),
        BarColumn(),
        TextColumn('{task.completed:5.1f} of {task.total:g} s simulated'),
        TextColumn('log10 L = {task.fields[level]}'),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task('observing', total=duration_s, level='…')
        heard, limit_s = 0, time.monotonic() + STALL_LIMIT_S
        while simulator.poll() is None or listener.is_behind:
            executor.spin_once(timeout_sec=0.1)
            _check(listener, stop, limit_s)
            if len(listener.lyapunov) > heard:
                heard, limit_s = len(listener.lyapunov), time.monotonic() + STALL_LIMIT_S
                level = _level(listener.lyapunov[-1])
                progress.update(task, completed=listener.elapsed_s, level=level)
        _spin_for(executor, LAST_MESSAGES_S)
        progress.update(task, completed=listener.elapsed_s)


def _check(listener: DemoListener, stop: StopSignal, limit_s: float) -> None:
    if stop.is_set:
        raise DemoError('interrupted')
    if listener.is_disturbed():
        raise DemoError('other nodes use the same topics; set ROS_DOMAIN_ID to a free number')
    if time.monotonic() > limit_s:
        raise DemoError(f'nothing was heard for {STALL_LIMIT_S:g} s; see the log files')


def _level(lyapunov: float) -> str:
    return f'{math.log10(lyapunov):6.2f}' if lyapunov > 0.0 else '-inf'


def _spin_for(executor: SingleThreadedExecutor, duration_s: float) -> None:
    end_s = time.monotonic() + duration_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=left_s)


if __name__ == '__main__':
    sys.exit(main())
