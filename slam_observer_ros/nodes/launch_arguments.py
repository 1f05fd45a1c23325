"""What launch files check before they start anything."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_prefix, PackageNotFoundError

from slam_observer_ros.nodes.message_classes import install_command


def check_file(context: Any, name: str) -> None:
    """Expand ~ in the launch argument ``name``; raise a RuntimeError if there is no such file.

    Launch itself would only warn, and start the node with its defaults.
    """
    written = context.launch_configurations[name]
    try:
        path = Path(written).expanduser().absolute()
    except RuntimeError as error:  # of a user that there is none of
        raise RuntimeError(f"{name}: no file '{written}': {error}") from error
    if not path.is_file():
        raise RuntimeError(f"{name}: no file '{path}'")
    context.launch_configurations[name] = str(path)


def check_optional_file(context: Any, name: str) -> None:
    """Do the same, unless the argument is empty."""
    if context.launch_configurations[name]:
        check_file(context, name)


def check_packages(*names: str) -> None:
    """Raise a RuntimeError that says what to install, if a package is missing."""
    for name in names:
        try:
            get_package_prefix(name)
        except PackageNotFoundError as error:
            raise RuntimeError(f'{name} is not installed: {install_command(name)}') from error


def is_true(given: Mapping[str, str], name: str) -> bool:
    """Return what a launch argument says; raise a RuntimeError if that is neither yes nor no."""
    written = given[name].lower()
    if written not in ('true', '1', 'false', '0'):
        raise RuntimeError(f"{name}: '{given[name]}' is neither true nor false")
    return written in ('true', '1')


def numbers(given: Mapping[str, str], name: str, count: int) -> list[float]:
    """Return the numbers of a launch argument; raise a RuntimeError unless there are ``count``."""
    words = given[name].replace(',', ' ').split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count:
        wanted = 'a number' if count == 1 else f'{count} numbers'
        raise RuntimeError(f"{name}: '{given[name]}' is not {wanted}")
    return values
