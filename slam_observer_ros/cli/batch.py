"""``slam-observer batch``: every recording with every setting, and a page that compares them."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
import logging
import os
from pathlib import Path

from slam_observer_ros.cli.batch_index import INDEX, SCORES, write_index
from slam_observer_ros.cli.batch_jobs import (
    find_recordings,
    grid_points,
    Job,
    Line,
    log_name,
    make_job,
    opened_log,
    part_of,
    read_logs,
    shard_of,
    write_failures,
)
from slam_observer_ros.cli.batch_pool import cluster_pool, local_pool, Pool
from slam_observer_ros.cli.console import (
    kept_warnings,
    muted_warnings,
    print_json,
    print_table,
    show_message,
    show_runs,
)
from slam_observer_ros.cli.options import add_settings_options, named, named_path, read_given
from slam_observer_ros.cli.outputs import check_directory
from slam_observer_ros.cli.replay import as_json, identity, summary_rows
from slam_observer_ros.cli.replay_files import write_report_of
from slam_observer_ros.cli.replay_outcome import with_logged
from slam_observer_ros.cli.replay_request import add_run_options, read_request, Records
from slam_observer_ros.cli.replay_run import replayed
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import IncompleteError, OutputError, UsageError
from slam_observer_ros.common.files import destination
from slam_observer_ros.recordings.opening import sha256_of
from slam_observer_ros.recordings.trajectory import write_tum
from slam_observer_ros.settings.node_settings import InputSettings

logger = logging.getLogger(__name__)

Failure = dict[str, object]


REPORTS, TRAJECTORIES = 'reports', 'trajectories'
"""Folders of ``--out`` for files of the runs."""


@dataclass(frozen=True, slots=True)
class Work:
    """Does the jobs of a batch, and writes those files of each that are asked for."""

    out: Path
    writes_reports: bool
    writes_trajectories: bool
    version: str = __version__

    def __call__(self, job: Job) -> dict[str, object]:
        """Do a run, write its files, and return its line of the log."""
        if self.version != __version__:
            raise UsageError(f'this worker has version {__version__}, the batch {self.version}')
        report = self._file(REPORTS, job, '.html') if self.writes_reports else None
        tum = self._file(TRAJECTORIES, job, '.tum') if self.writes_trajectories else None
        records = Records(poses=tum is not None, whole_run=report is not None)
        with kept_warnings() as warnings:
            outcome, _ = replayed(replace(job.request, records=records), shows_progress=False)
        outcome = with_logged(outcome, warnings)
        if tum is not None:
            write_tum(outcome.trajectory, tum)
        if report is not None:
            write_report_of(job.file_stem, outcome, summary_rows(outcome), report)
        return {
            'run': job.run_id,
            'grid': job.point,
            'report': self._relative(report),
            'trajectory': self._relative(tum),
            **identity(job.recording, job.recording_sha256, outcome),
            **as_json(outcome),
        }

    def _file(self, folder: str, job: Job, suffix: str) -> Path:
        return self.out / folder / f'{job.file_stem}{suffix}'

    def _relative(self, file: Path | None) -> str | None:
        return None if file is None else file.relative_to(self.out).as_posix()


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Replay every recording with every setting. What is done is kept: the same command goes '
        'on where it was stopped, and does no run twice.'
    )
    parser.add_argument(
        'recordings',
        nargs='+',
        type=named,
        metavar='RECORDING',
        help="recordings, or patterns such as 'recordings/**/*.mcap'",
    )
    parser.add_argument(
        '--grid',
        action='append',
        default=[],
        metavar='NAME=VALUE,VALUE…',
        help='values of a parameter; of several, every combination is run',
    )
    outputs = parser.add_argument_group('outputs')
    outputs.add_argument(
        '--out',
        type=named_path,
        required=True,
        metavar='DIR',
        help='where runs.jsonl, a line for each run, and index.html are written',
    )
    outputs.add_argument('--reports', action='store_true', help='write a report of each run')
    outputs.add_argument(
        '--trajectories', action='store_true', help='write the trajectory of each run, as TUM'
    )
    outputs.add_argument(
        '--score', choices=SCORES, default=SCORES[0], help='which figure the best has least of'
    )
    outputs.add_argument('--json', action='store_true', help='print one JSON object')
    where = parser.add_argument_group('where it runs')
    where.add_argument(
        '--workers',
        type=_worker_count,
        default=len(os.sched_getaffinity(0)),
        metavar='N',
        help='processes of this machine (default: one for each of its cores)',
    )
    where.add_argument(
        '--scheduler',
        metavar='tcp://HOST:PORT',
        help='run on the workers of this Dask scheduler, which find recordings and --out at the '
        'same paths',
    )
    where.add_argument(
        '--shard',
        type=shard_of,
        default=(1, 1),
        metavar='i/N',
        help='do only the i-th of N parts, as an array job does',
    )
    add_run_options(parser)
    add_settings_options(parser, InputSettings)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Do the runs that are not done yet, and write the index of all."""
    recordings, points = find_recordings(args.recordings), grid_points(args.grid)
    request = read_request(args, read_given(args), recordings[0])
    requests = [request.with_values(point) for point in points]
    pool = _pool(args, len(recordings) * len(points))
    _make_folders(args)
    with opened_log(args.out / log_name('runs', args.shard)) as log:
        done_before = read_logs(args.out)
        hashes, failures = _hashes(args, recordings, len(points))
        jobs = [
            make_job(
                replace(requests[number], recording=recording), hashes[recording], points[number]
            )
            for recording, part in _parts(args, recordings, len(points))
            if recording in hashes
            for number in part
        ]
        left = _without_repeats(
            job for job in jobs if not _is_done(args, done_before.get(job.run_id))
        )
        try:
            ended_runs = pool.run(Work(args.out.absolute(), args.reports, args.trajectories), left)
            for ended in show_runs(ended_runs, 'running', len(left)):
                if ended.result is not None:
                    log.append(ended.result)
                else:
                    failures.append(_failed(ended.job.recording, ended.failure, ended.job))
        except KeyboardInterrupt:
            show_message('warning', 'Stopped; the same command goes on from here.')
            raise
        finally:
            write_failures(args.out / log_name('failed', args.shard), failures)
            with muted_warnings():  # which were shown before
                lines = read_logs(args.out)
            write_index(args.out, lines, args.score)
    _report(args, [job.run_id for job in jobs], len(left), failures)


def _worker_count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"a number of processes from 1 is needed, not '{text}'")
    return int(text)


def _pool(args: argparse.Namespace, jobs: int) -> Pool:
    if args.scheduler is not None:
        return cluster_pool(args.scheduler, jobs)
    return local_pool(args.workers)


def _make_folders(args: argparse.Namespace) -> None:
    """Make the directories of the outputs, whose files must not be in the way either."""
    wanted = {REPORTS: args.reports, TRAJECTORIES: args.trajectories}
    folders = [args.out / name for name, is_wanted in wanted.items() if is_wanted]
    for folder in (args.out, *folders):
        check_directory(folder)
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"can't make the directory {folder}: {error.strerror}") from error
    for file in (*(log_name(kind, args.shard) for kind in ('runs', 'failed')), INDEX):
        destination(args.out / file)


def _is_done(args: argparse.Namespace, line: Line | None) -> bool:
    """Return whether a run is in the log, and the files of it that are asked for are there."""
    if line is None:
        return False
    wanted = {'report': args.reports, 'trajectory': args.trajectories}
    files = [line[kind] for kind, is_wanted in wanted.items() if is_wanted]
    return all(file is not None and (args.out / file).is_file() for file in files)


def _parts(
    args: argparse.Namespace, recordings: Sequence[Path], points: int
) -> list[tuple[Path, range]]:
    """Return the recordings of this shard, each with the points that it is to run."""
    parts = zip(recordings, part_of(recordings, points, args.shard), strict=True)
    return [(recording, part) for recording, part in parts if part]


def _hashes(
    args: argparse.Namespace, recordings: Sequence[Path], points: int
) -> tuple[dict[Path, str], list[Failure]]:
    """Return the hash of each recording of this shard, and which can't be read."""
    wanted = [recording for recording, _ in _parts(args, recordings, points)]
    pool = Pool(ThreadPoolExecutor, args.workers)
    if args.scheduler is not None:
        pool = cluster_pool(args.scheduler, len(wanted))
    hashes: dict[Path, str] = {}
    failures = []
    for ended in show_runs(pool.run(sha256_of, wanted), 'hashing', len(wanted)):
        if ended.result is not None:
            hashes[ended.job] = ended.result
        else:
            failures.append(_failed(ended.job, ended.failure))
    return hashes, failures


def _without_repeats(jobs: Iterable[Job]) -> list[Job]:
    """Return jobs, each once: of recordings that are the same, the first stands for all."""
    kept: dict[str, Job] = {}
    for job in jobs:
        first = kept.setdefault(job.run_id, job)
        if first is not job:
            logger.warning('%s is the same as %s.', job.recording, first.recording)
    return list(kept.values())


def _failed(recording: Path, reason: str, job: Job | None = None) -> Failure:
    logger.warning('%s failed: %s', recording, reason)
    run = {} if job is None else {'run': job.run_id, 'grid': job.point}
    return {'recording': str(recording), 'error': reason, **run}


def _report(
    args: argparse.Namespace, run_ids: Sequence[str], new: int, failures: Sequence[Failure]
) -> None:
    """Print what was done; raise an IncompleteError if something was not."""
    failed_file = args.out / log_name('failed', args.shard)
    counts = {
        'runs': len(set(run_ids)),
        'done_before': len(set(run_ids)) - new,
        'failed': len(failures),
    }
    if args.json:
        print_json(counts | {'index': str(args.out / INDEX)})
    else:
        rows = {name.replace('_', ' '): str(count) for name, count in counts.items()}
        print_table(str(args.out), rows | {'index': str(args.out / INDEX)})
    if failures:
        raise IncompleteError(
            f'{len(failures)} runs failed, see {failed_file}; the same command tries them again'
        )
