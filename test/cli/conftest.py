"""Recordings that are replayed."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import shutil

import pytest
import recordings

from slam_observer_ros.cli import batch
from slam_observer_ros.cli.batch import Pool
from slam_observer_ros.cli.main import main


@pytest.fixture(scope='session')
def simulated_once(tmp_path_factory):
    path = tmp_path_factory.mktemp('simulated') / 'simulated.mcap'
    assert main(['simulate', '--duration', '5', '--output', str(path)]) == 0
    return path


@pytest.fixture
def simulated(simulated_once, tmp_path):
    """A simulated run of five seconds, 50 Hz, with truth."""
    return Path(shutil.copy(simulated_once, tmp_path))


@pytest.fixture
def no_processes(monkeypatch):
    """Let a batch do its runs in the test's process, as others take a second to start."""
    monkeypatch.setattr(batch, 'local_pool', lambda _: Pool(ThreadPoolExecutor, 1))


@pytest.fixture(scope='session')
def beginning(tmp_path_factory):
    """Half a minute of the sample, with errors and truth."""
    path = tmp_path_factory.mktemp('beginning') / 'beginning.mcap'
    return recordings.write_beginning(path, recordings.SAMPLE, 30.0)


@pytest.fixture(scope='session')
def run_in_every_format(tmp_path_factory):
    return recordings.write_all_formats(tmp_path_factory.mktemp('formats'))
