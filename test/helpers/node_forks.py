"""A program that has loaded what nodes need, and forks for each: that saves a second of loading.

It has no threads and nothing of ROS that runs. What it is asked for comes as a line of JSON on its
standard input: to start a node, or for the exit code of one. It answers by a line each.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

from slam_observer_ros.common.process import use_one_thread

use_one_thread()

from slam_observer_ros.nodes import observer_nodes, runner, simulator  # noqa: E402, F401
from slam_observer_ros.nodes.executables import EXECUTABLES  # noqa: E402


def main() -> None:
    """Answer until there are no more questions; a node goes on from here in its own process."""
    for line in sys.stdin:
        asked: dict[str, Any] = json.loads(line)
        if 'name' not in asked:
            ended, status = os.waitpid(asked['process'], os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if ended else None
        elif (answer := os.fork()) == 0:
            become(**asked)
        sys.stdout.write(f'{json.dumps(answer)}\n')
        sys.stdout.flush()


def become(name: str, log: str, arguments: list[str], environment: dict[str, str]) -> None:
    """Be a node whose output goes to a file, as if it had just been started."""
    for file in (0, 1, 2):
        os.close(file)
    os.open(os.devnull, os.O_RDONLY)
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = [name, *arguments]
    sys.exit(EXECUTABLES[name]())


if __name__ == '__main__':
    main()
