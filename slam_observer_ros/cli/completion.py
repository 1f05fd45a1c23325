"""What a shell completes, with argcomplete: commands, options, parameters, parameter files."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def typed_words(environment: Mapping[str, str]) -> list[str] | None:
    """Return the words after the program that a shell wants completed; None if it wants none."""
    if '_ARGCOMPLETE' not in environment:
        return None
    return environment.get('COMP_LINE', '').split()[1:]


def complete(parser: argparse.ArgumentParser) -> None:
    """Write the completions and exit."""
    import argcomplete  # which --help has no use for

    argcomplete.autocomplete(parser)


def completed_by(action: argparse.Action, completer: Callable[..., Sequence[str]]) -> None:
    """Have an option's value completed by what a function returns, as argcomplete takes it."""
    described: Any = action
    described.completer = completer
