"""The executables: each waits for signals from its first instant, then loads and runs a node."""

from __future__ import annotations

from collections.abc import Callable
import sys

from slam_observer_ros.common.process import StopSignal


def observer_node() -> int:
    """Run the SLAM observer until it is asked to stop; return the exit code."""
    stop = _begin()
    from slam_observer_ros.nodes.observer_nodes import ObserverNode
    from slam_observer_ros.nodes.runner import run

    return run(ObserverNode, stop=stop)


def lifecycle_observer_node() -> int:
    """Run it as a managed node."""
    stop = _begin()
    from slam_observer_ros.nodes.observer_nodes import LifecycleObserverNode
    from slam_observer_ros.nodes.runner import run

    return run(LifecycleObserverNode, stop=stop)


def simulator_node() -> int:
    """Run the paper's simulation until its laps are over or it is asked to stop."""
    stop = _begin()
    from slam_observer_ros.nodes.runner import run
    from slam_observer_ros.nodes.simulator import SimulatorNode

    return run(SimulatorNode, stop=stop)


def _begin() -> StopSignal:
    stop = StopSignal()  # before all else: what a node imports takes seconds
    from slam_observer_ros.common.process import use_one_thread

    use_one_thread()
    return stop


EXECUTABLES: dict[str, Callable[[], int]] = {
    main.__name__: main for main in (observer_node, lifecycle_observer_node, simulator_node)
}

if __name__ == '__main__':  # python -m slam_observer_ros.nodes.executables NAME ...
    sys.exit(EXECUTABLES[sys.argv.pop(1)]())
