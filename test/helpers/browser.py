"""Headless Chromium, as a user's browser opens a page: without a network."""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path
import shutil
import subprocess
import tempfile

import pytest


@dataclass(frozen=True)
class Opened:
    """A page as it is after its scripts have run, and what the browser complained of."""

    html: str
    console: list[str]
    requested: list[str]


def chromium() -> str:
    """Return the browser's command; skip the test where there is none."""
    command = shutil.which('chromium') or shutil.which('chromium-browser')
    if command is None:
        pytest.skip('no Chromium is installed (apt-get install chromium)')
    return command


def open_page(path: Path, fragment: str = '', *options: str) -> Opened:
    """Open a file, let its scripts run for some seconds, and return what has become of it."""
    with tempfile.TemporaryDirectory() as directory:
        log = Path(directory) / 'net.json'
        command = [
            chromium(),
            '--headless=new',
            '--no-sandbox',
            '--disable-gpu',
            '--disable-background-networking',
            '--enable-logging=stderr',
            '--virtual-time-budget=10000',
            f'--user-data-dir={directory}/profile',
            f'--log-net-log={log}',
            '--dump-dom',
            *options,
            f'{path.as_uri()}{fragment}',
        ]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
        console = [line for line in ended.stderr.splitlines() if ':CONSOLE' in line]
        return Opened(ended.stdout, console, _requested(log))


def _requested(log: Path) -> list[str]:
    """Return what pages asked for: the browser's own requests have no origin, a file's a null."""
    parameters = [event.get('params', {}) for event in json.loads(log.read_text())['events']]
    return [found['url'] for found in parameters if found.get('initiator') == 'null']
