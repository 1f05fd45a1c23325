"""The package's structure in numbers: ``python benchmark/structure.py``; a test keeps them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
import inspect
import io
import logging
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from types import FrameType

import worlds

from slam_observer_ros.cli.main import main as command_line
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.step import step

PACKAGE = worlds.CHECKOUT / 'slam_observer_ros'
TRACED_AFTER = 200
"""Observations of the simulated wheeled loop before the one that is traced."""


@dataclass(frozen=True, slots=True)
class TracedStep:
    """What runs while the estimator uses one event, with Riccati gains.

    Attributes
    ----------
    modules : list of str
        Modules of the package, in the order in which they are entered first.
    functions, changes, depth : int
        How many functions are called, how often a call leads to another module, and how deep the
        stack of calls within the package is.
    method : list of str
        Names of the functions that ``tracking.step.step`` itself calls.

    """

    modules: list[str]
    functions: int
    changes: int
    depth: int
    method: list[str]


def main() -> None:
    """Print all numbers."""
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    chain, traced = longest_chain(), traced_step()
    docstrings, lines = docstring_lines()
    rows = {
        'modules': len(modules()),
        'loose modules at the top': len(loose_modules()),
        'layers': layers(),
        'longest import chain': f'{len(chain)}: {" > ".join(chain)}',
        'traced step, modules': f'{len(traced.modules)}: {", ".join(traced.modules)}',
        'traced step, functions called': traced.functions,
        'traced step, changes of module': traced.changes,
        'traced step, depth': traced.depth,
        'calls of its method': f'{len(traced.method)}: {", ".join(traced.method)}',
        'traced velocity, functions called': traced_velocity().functions,
        'modules entered by replay --report': len(entered_by_a_report()),
        'lines': lines,
        'share of docstrings': f'{docstrings / lines:.1%}',
    }
    for name, value in rows.items():
        sys.stdout.write(f'{name}: {value}\n')


def modules() -> dict[str, Path]:
    """Return the package's modules by their dotted names, without the package's own name."""
    found = {}
    for path in sorted(PACKAGE.rglob('*.py')):
        parts = path.relative_to(PACKAGE).with_suffix('').parts
        found['.'.join(parts[:-1] if parts[-1] == '__init__' else parts)] = path
    return found


def loose_modules() -> list[str]:
    """Return the modules beside the folders."""
    return sorted(path.stem for path in PACKAGE.glob('*.py'))


def layers() -> int:
    """Return how many layers import-linter holds apart."""
    text = (worlds.CHECKOUT / 'pyproject.toml').read_text(encoding='utf-8')
    return text.partition('layers = [')[2].partition(']')[0].count(',')


def longest_chain() -> list[str]:
    """Return modules each of which imports the next, as many as there are in a row."""
    graph, known = imports(), dict[str, list[str]]()

    def chain(module: str, above: frozenset[str]) -> list[str]:
        if module not in known:
            below = [chain(other, above | {module}) for other in graph[module] - above - {module}]
            known[module] = [module, *max(below, key=len, default=[])]
        return known[module]

    return max((chain(module, frozenset()) for module in graph), key=len)


def imports() -> dict[str, set[str]]:
    """Return which modules of the package each of them imports, by name."""
    names = modules()
    return {
        module: {name for name in _imported(path) if name in names}
        for module, path in names.items()
    }


def _imported(path: Path) -> Iterator[str]:
    prefix = f'{PACKAGE.name}.'
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith(prefix):
            module = (node.module or '').removeprefix(prefix)
            yield module
            yield from (f'{module}.{alias.name}' for alias in node.names)


def docstring_lines() -> tuple[int, int]:
    """Return how many lines docstrings have, and how many there are."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = lines = 0
    for path in modules().values():
        text = path.read_text(encoding='utf-8')
        lines += text.count('\n')
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, kinds) and ast.get_docstring(node, clean=False) is not None:
                docstrings += (node.body[0].end_lineno or 0) - node.body[0].lineno + 1
    return docstrings, lines


def traced_step(settings: Settings | None = None) -> TracedStep:
    """Return what an observation with ids takes in the midst of the simulated wheeled loop."""
    return _traced_kind(ObservationEvent, settings)


def traced_velocity() -> TracedStep:
    """Return what a velocity takes there."""
    return _traced_kind(VelocityEvent)


def _traced_kind(kind: type[Event], settings: Settings | None = None) -> TracedStep:
    world = worlds.load('simulated loop, wheeled')
    estimator = Estimator(replace(settings or world.settings, gains='riccati'))
    observed = 0
    for event in world.events:
        if isinstance(event, kind) and observed >= TRACED_AFTER:
            return _traced(estimator, event)
        observed += isinstance(event, ObservationEvent)
        estimator.add(event)
    raise ValueError('the world has too few observations')


def entered_by_a_report() -> set[str]:
    """Return the modules in which a function is called by ``replay --report`` of the sample."""
    entered: set[str] = set()

    def note(frame: FrameType, kind: str, _argument: object) -> None:
        path = frame.f_code.co_filename
        is_function = frame.f_code.co_flags & inspect.CO_OPTIMIZED  # and no class's body
        if kind == 'call' and is_function and str(PACKAGE) in path:
            entered.add(path.removeprefix(f'{PACKAGE}/').removesuffix('.py'))

    with TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):
        sample, report = worlds.CHECKOUT / 'samples' / 'sample.mcap', Path(folder) / 'report.html'
        sys.setprofile(note)
        try:
            command_line(['replay', str(sample), '--report', str(report)])
        finally:
            sys.setprofile(None)
    return entered


def _traced(estimator: Estimator, event: Event) -> TracedStep:
    entered: list[str] = []
    stack: list[str] = []
    method: list[str] = []
    counts = {'functions': 0, 'changes': 0, 'depth': 0}

    def note(frame: FrameType, kind: str, _argument: object) -> None:
        path = frame.f_code.co_filename
        if str(PACKAGE) not in path or frame.f_code.co_name.startswith('<'):
            return
        module = path.removeprefix(f'{PACKAGE}/').removesuffix('.py')
        if kind == 'call':
            caller = frame.f_back and frame.f_back.f_code
            if caller is step.__code__ and frame.f_code.co_name not in method:
                method.append(frame.f_code.co_name)
            if module not in entered:
                entered.append(module)
            counts['functions'] += 1
            counts['changes'] += bool(stack) and stack[-1] != module
            stack.append(module)
            counts['depth'] = max(counts['depth'], len(stack))
        elif kind == 'return' and stack:
            stack.pop()

    sys.setprofile(note)
    try:
        estimator.add(event)
    finally:
        sys.setprofile(None)
    return TracedStep(entered, counts['functions'], counts['changes'], counts['depth'], method)


if __name__ == '__main__':
    main()
