"""Runs ``slam-observer`` inside the test, as a shell would."""

from __future__ import annotations

from dataclasses import dataclass
import json
from typing import Any

import pytest

from slam_observer_ros.cli.main import main


@dataclass(frozen=True)
class Ended:
    """A command that has ended: its exit code and what it wrote."""

    code: int
    output: str
    errors: str

    @property
    def json(self) -> Any:
        """The one object on standard output."""
        return json.loads(self.output, parse_constant=_refuse)


def _refuse(name: str) -> None:
    raise AssertionError(f'{name} is no JSON')


class CommandLine:
    """Runs commands and catches what they write."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: object) -> Ended:
        """Run a command to its end."""
        self._capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as exit_:
            code = int(exit_.code or 0)
        captured = self._capsys.readouterr()
        return Ended(code, captured.out, captured.err)

    def succeed(self, *arguments: object) -> Ended:
        """Run a command that ends without a word of complaint."""
        ended = self(*arguments)
        assert (ended.code, ended.errors) == (0, '')
        return ended

    def fail(self, *arguments: object) -> str:
        """Run a wrong command; return the one line that it is refused with."""
        ended = self(*arguments)
        assert (ended.code, ended.output) == (2, '')
        assert ended.errors.startswith('slam-observer: error: ')
        assert ended.errors.count('\n') == 1
        return ended.errors
