"""Programs that run as if packages were not installed."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

PROGRAM = """\
import importlib.abc, sys

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {absent}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name)

sys.meta_path.insert(0, Absent())
from {module} import {name}
sys.exit({name}())
"""


def program_without(
    absent: Collection[str], module: str, folder: Path, name: str = 'main'
) -> Path:
    """Write a program that calls a function of a module where the packages ``absent`` miss."""
    path = folder / f'{name}.py'
    path.write_text(PROGRAM.format(absent=tuple(absent), module=module, name=name))
    return path


def node_without(absent: Collection[str], name: str, folder: Path) -> Path:
    """Write a program that runs a node likewise."""
    return program_without(absent, 'slam_observer_ros.nodes.executables', folder, name)
