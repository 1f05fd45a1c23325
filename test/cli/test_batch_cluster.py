"""A batch on a real Dask cluster: a scheduler and two workers on loopback, one of them killed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import subprocess
import sys
import time

import pytest
from recordings import SAMPLE

from slam_observer_ros.cli import batch as batch_module
from slam_observer_ros.cli.batch import read_logs

pytest.importorskip('distributed', reason="no Dask is installed (pip's extra 'cluster')")

PATIENCE_S = 100.0
RUNS = 5
GRID = ('--grid', 'range_noise=' + ','.join(f'0.{number}' for number in range(1, RUNS + 1)))


class Cluster:
    """A scheduler and its workers, as processes."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._log = (folder / 'dask.log').open('w')
        self._scheduler_file = folder / 'scheduler.json'
        self.scheduler = self._start('scheduler', '--no-dashboard', '--no-show')
        self.workers = [
            self._start('worker', '--no-nanny', '--nthreads', '1', '--no-dashboard')
            for _ in range(2)
        ]
        deadline = time.monotonic() + PATIENCE_S
        while self.output.count('Starting established connection to') < 2:
            assert time.monotonic() < deadline, self.output
            time.sleep(0.05)

    def _start(self, kind: str, *options: str) -> subprocess.Popen[bytes]:
        listen = ('--host', '127.0.0.1', '--port', '0') if kind == 'scheduler' else ()
        worker_host = ('--host', '127.0.0.1') if kind == 'worker' else ()
        command = [sys.executable, '-m', f'distributed.cli.dask_{kind}', *listen, *worker_host]
        command += ['--scheduler-file', str(self._scheduler_file), *options]
        return subprocess.Popen(
            command, cwd=self._folder, stdout=subprocess.DEVNULL, stderr=self._log
        )

    @property
    def output(self) -> str:
        return (self._folder / 'dask.log').read_text()

    @property
    def address(self) -> str:
        found = re.search(r'"address": "(tcp://[^"]+)"', self._scheduler_file.read_text())
        assert found
        return found.group(1)

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()
        self._log.close()


@pytest.fixture(name='cluster')
def fixture_cluster(tmp_path) -> Iterator[Cluster]:
    cluster = Cluster(tmp_path)
    try:
        yield cluster
    finally:
        cluster.stop()


def figures_of(lines):
    return {run: {**line, 'seconds': None} for run, line in lines.items()}


@pytest.mark.timeout(400)  # Dask takes long to start on a busy machine
def test_a_cluster_that_loses_a_worker_does_every_run_once(
    cluster, slam_observer, no_processes, beginning, tmp_path
):
    remote, local = tmp_path / 'remote', tmp_path / 'local'
    command = [sys.executable, '-m', 'slam_observer_ros.cli.main', 'batch', str(beginning), *GRID]
    batch = subprocess.Popen(
        [*command, '--out', str(remote), '--scheduler', cluster.address, '--trajectories']
    )
    deadline = time.monotonic() + PATIENCE_S
    while not read_logs(remote):
        assert batch.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    cluster.workers[0].kill()
    assert len(read_logs(remote)) < RUNS
    assert batch.wait(PATIENCE_S) == 0
    lines = read_logs(remote)
    assert len((remote / 'runs.jsonl').read_text().splitlines()) == len(lines) == RUNS
    slam_observer.succeed('batch', beginning, *GRID, '--out', local, '--trajectories')
    assert figures_of(lines) == figures_of(read_logs(local))
    for line in lines.values():
        file = line['trajectory']
        assert (remote / file).read_bytes() == (local / file).read_bytes()


ADDRESSES = ('tls://127.0.0.1:9', '', 'host', 'tcp:', 'tcp://[x:1', 'inproc://x', 'http://a:1')


def test_a_scheduler_that_can_not_be_is_an_error_in_one_line(tmp_path):
    # In a process of its own, as what a client leaves behind shows when that ends.
    options = ('batch', str(SAMPLE), '--out', str(tmp_path / 'r'), '--scheduler')
    program = (
        'from slam_observer_ros.cli.main import main\n'
        'print(*(main([*{}, address]) for address in {}))'
    )
    ended = subprocess.run(
        [sys.executable, '-c', program.format(options, ADDRESSES)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert ended.stdout.split() == ['2'] * len(ADDRESSES)
    lines = ended.stderr.splitlines()
    assert len(lines) == len(ADDRESSES)
    assert all('no Dask scheduler answers there' in line for line in lines)


def test_a_scheduler_that_does_not_answer_is_an_error_in_one_line(
    monkeypatch, slam_observer, tmp_path
):
    monkeypatch.setattr(batch_module, 'CONNECT_S', 1.0)
    options = ('batch', SAMPLE, '--out', tmp_path / 'r', '--scheduler', 'tcp://127.0.0.1:9')
    assert 'no Dask scheduler answers there' in slam_observer.fail(*options)
    assert not list(tmp_path.iterdir())
