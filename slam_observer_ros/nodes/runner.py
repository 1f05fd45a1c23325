"""Start a node, spin it and stop it cleanly; shared by all nodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
import os
import sys
import threading

import rclpy
from rclpy.exceptions import (
    InvalidHandle,
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from slam_observer_ros.common.errors import SlamObserverError
from slam_observer_ros.common.process import StopSignal

try:
    from rclpy.experimental.events_executor import EventsExecutor
except ImportError:  # rclpy before 7.1.4
    EventsExecutor = None

# What a node may raise at its start; the last one of what rclpy declares, as use_sim_time.
REFUSALS = (SlamObserverError, InvalidParameterValueException, InvalidParameterTypeException)

USAGE = """\
usage: ros2 run slam_observer_ros NODE [--ros-args [-p NAME:=VALUE] [--params-file FILE]
                                                   [-r TOPIC:=/OTHER_TOPIC] ...]

docs/topics.md lists the topics and services of observer_node, docs/parameters.md all parameters;
of a running node `ros2 param list` does.
"""

STOP_LATENCY_S = 0.1  # longest time that an idle node takes to notice a signal
PATIENCE_S = 1.2  # how long a node may take to end, as within a long computation; launch waits 5 s


def run(
    make_node: Callable[[], Node],
    args: Sequence[str] | None = None,
    stop: StopSignal | None = None,
) -> int:
    """Make a node and spin it until it shuts its context down or a signal asks it to stop.

    ``args`` is a command line with ROS arguments, None for the process's own; ``stop`` has waited
    for signals since the process began. The exit code that is returned is 0 after a clean stop, 1
    if something could not be saved at the end, 2 where ROS or the node refused to start.
    """
    stop = StopSignal() if stop is None else stop
    stop.begin()
    try:
        rclpy.init(
            args=list(args) if args is not None else None,
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except RuntimeError as error:  # of which rclpy makes its own, as of a file that is missing
        reason = str(error).partition(', at /')[0]
        get_logger('slam_observer_ros').fatal(f'{type(error).__name__}: {reason}')
        return 2
    try:
        unknown = [arg for arg in remove_ros_args(args)[1:] if arg not in ('', '--')]
        if {'-h', '--help'} & set(unknown):
            sys.stdout.write(USAGE)
            return 0
        if unknown:
            get_logger('slam_observer_ros').fatal(
                f'unknown arguments {" ".join(unknown)}: parameters, files of them and remappings '
                'come after --ros-args'
            )
            return 2
        return _spin(make_node, stop)
    finally:
        rclpy.try_shutdown()
        stop.ignore()


def _spin(make_node: Callable[[], Node], stop: StopSignal) -> int:
    try:
        node = make_node()
    except REFUSALS as error:
        get_logger('slam_observer_ros').fatal(_reason(error))
        return 2
    has_ended = threading.Event()
    if hasattr(node, 'end_in_haste'):
        threading.Thread(target=_watch, args=(node, stop, has_ended), daemon=True).start()
    executor = _executor()
    stop.listen()  # EventsExecutor has taken SIGINT and SIGTERM
    executor.add_node(node)
    try:
        while not stop.is_set and rclpy.ok():
            turn(executor)
    except ExternalShutdownException:
        node.get_logger().debug('context was shut down')
    finally:
        executor.shutdown()
        exit_code = 0
        try:
            node.destroy_node()
        except SlamObserverError as error:
            get_logger('slam_observer_ros').error(str(error))
            exit_code = 1
        has_ended.set()
    return exit_code


def turn(executor: Executor) -> None:
    """Let an executor do what is due, or wait for a moment."""
    # rclpy's other executors pass over a service that was removed while it was called.
    with suppress(InvalidHandle):
        executor.spin_once(timeout_sec=STOP_LATENCY_S)


def _reason(error: Exception) -> str:
    """Return what is wrong, without the words that rclpy has around it."""
    text = str(error)
    if isinstance(error, SlamObserverError):
        return text
    return text.partition('Reason: ')[2].rpartition(': ')[0] or text


def _executor() -> Executor:
    """Return what hears of each message by itself, if rclpy has it: the other asks for all."""
    return SingleThreadedExecutor() if EventsExecutor is None else EventsExecutor()


def _watch(node: Node, stop: StopSignal, has_ended: threading.Event) -> None:
    """End the process if the node does not do so in time after a signal."""
    stop.wait()
    if not has_ended.wait(PATIENCE_S):
        exit_code = node.end_in_haste()
        if exit_code is not None:
            os._exit(exit_code)
