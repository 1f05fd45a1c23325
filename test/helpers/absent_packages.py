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
from {module} import main
sys.exit(main())
"""


def program_without(absent: Collection[str], module: str, folder: Path) -> Path:
    """Write a program that calls ``module.main`` where the packages ``absent`` are missing."""
    path = folder / f'{module}.py'
    path.write_text(PROGRAM.format(absent=tuple(absent), module=module))
    return path
