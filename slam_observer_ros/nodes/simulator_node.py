"""Executable: the paper's simulation as a ROS 2 node."""

from __future__ import annotations

import sys

from slam_observer_ros.nodes.stop_signal import StopSignal


def main() -> int:
    """Run the node until its laps are over or it is asked to stop; return the exit code."""
    stop = StopSignal()  # before all else: what is imported here takes seconds
    from slam_observer_ros.common.threads import use_one_thread

    use_one_thread()
    from slam_observer_ros.nodes.runner import run
    from slam_observer_ros.nodes.simulator import SimulatorNode

    return run(SimulatorNode, stop=stop)


if __name__ == '__main__':
    sys.exit(main())
