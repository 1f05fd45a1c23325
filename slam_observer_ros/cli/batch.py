"""``slam-observer batch``: every recording with every setting, and a page that compares them.

A run that is done is a JSON line, appended when it is finished and never changed. Each shard has a
file of its own, so that no two programs write to one; what one reads is all of them.
"""

from __future__ import annotations

import argparse
import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent import futures
from contextlib import AbstractContextManager, contextmanager
import dataclasses
from dataclasses import dataclass, replace
import fcntl
from functools import partial
import glob
import hashlib
import itertools
import json
import logging
import multiprocessing
import os
from pathlib import Path
import re
import signal
import sys
import threading
from typing import Any, Generic, TypeVar

from slam_observer_ros.cli.console import print_json, print_table, show_message, show_progress
from slam_observer_ros.cli.options import (
    add_run_options,
    add_settings_options,
    check_directory,
    named,
    options,
    parse_value,
    read_given,
    read_request,
)
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import (
    failing,
    IncompleteError,
    json_text,
    message_of,
    OutputError,
    shown,
    SlamObserverError,
    UsageError,
)
from slam_observer_ros.common.files import destination, not_special, unfinished_file
from slam_observer_ros.common.findings import kept_warnings, muted_warnings
from slam_observer_ros.mapping.map_file import map_files
from slam_observer_ros.recordings.opening import sha256_of
from slam_observer_ros.recordings.trajectory import write_tum
from slam_observer_ros.report.page import FILES, INDEX, Line, SCORES, write_index, write_report
from slam_observer_ros.report.summary import as_json, FIGURES, identity, summary_rows
from slam_observer_ros.runs.replay import result_of
from slam_observer_ros.runs.result import Request
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_table import changed_names, suggestion, table, Value

logger = logging.getLogger(__name__)

_KNOWN = {row.name: row for row in (*table(InputSettings), *table(Settings))}

_ID_DIGITS = 16

Point = dict[str, Value]  # values of the parameters of ``--grid``, by name


@dataclass(frozen=True, slots=True)
class Job:
    """A run that is to be done; ``run_id`` is a hash of all that its figures depend on."""

    run_id: str
    recording_sha256: str
    point: Point
    request: Request

    @property
    def recording(self) -> Path:
        """The recording that is replayed."""
        return self.request.recording

    @property
    def file_stem(self) -> str:
        """Name of its files, without a suffix; no other run has it."""
        return f'{self.recording.stem}-{self.run_id}'


REPORTS, TRAJECTORIES = 'reports', 'trajectories'  # folders of ``--out`` for files of the runs


def do(out: Path, writes_reports: bool, writes_trajectories: bool, version: str, job: Job) -> Line:
    """Do a run, write its files below ``out``, and return its line of the log."""
    if version != __version__:
        raise UsageError(f'this worker has version {__version__}, the batch {version}')
    report = f'{REPORTS}/{job.file_stem}.html' if writes_reports else None
    tum = f'{TRAJECTORIES}/{job.file_stem}.tum' if writes_trajectories else None
    request = replace(job.request, keeps_poses=tum is not None, keeps_run=report is not None)
    with kept_warnings() as warnings:
        result = result_of(request)
    result = replace(result, logged=warnings)
    if tum is not None:
        write_tum(result.trajectory, out / tum)
    if report is not None:
        write_report(out / report, result, job.file_stem, summary_rows(result))
    return {
        'run': job.run_id,
        'grid': job.point,
        'report': report,
        'trajectory': tum,
        **identity(job.recording, job.recording_sha256, result),
        **as_json(result),
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Replay every recording with every setting. What is done is kept: the same command goes '
        'on where it was stopped, and does no run twice.'
    )
    options(
        parser,
        """
        recordings RECORDING: recordings, or patterns such as 'recordings/**/*.mcap'
        --grid NAME=VALUE,VALUE…: values of a parameter; of several, every combination is run
        """,
        recordings={'nargs': '+', 'type': named},
        grid={'action': 'append', 'default': []},
    )
    options(
        parser.add_argument_group('outputs'),
        """
        --out DIR: where runs.jsonl, a line for each run, and index.html are written
        --reports: write a report of each run
        --trajectories: write the trajectory of each run, as TUM
        --score: which figure the best has least of
        --json: print one JSON object
        """,
        out={'required': True},
        score={'choices': SCORES, 'default': SCORES[0]},
    )
    options(
        parser.add_argument_group('where it runs'),
        """
        --workers N: processes of this machine (default: one for each of its cores)
        --scheduler tcp://HOST:PORT: run on the workers of this Dask scheduler, which find
            recordings and --out at the same paths
        --shard i/N: do only the i-th of N parts, as an array job does
        """,
        workers={'type': _worker_count, 'default': len(os.sched_getaffinity(0))},
        shard={'type': shard_of, 'default': (1, 1)},
    )
    add_run_options(parser)
    add_settings_options(parser, InputSettings)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Do the runs that are not done yet, and write the index of all."""
    recordings, points = find_recordings(args.recordings), grid_points(args.grid)
    request = read_request(args, read_given(args), recordings[0])
    requests = [request.with_values(point) for point in points]
    # Asked before anything is written
    pool = local_pool(args.workers)
    if args.scheduler is not None:
        pool = cluster_pool(args.scheduler, len(recordings) * len(points))
    wanted = {'report': args.reports, 'trajectory': args.trajectories}
    _make_folders(args)
    failed_file = args.out / log_name('failed', args.shard)
    with opened_log(args.out / log_name('runs', args.shard)) as append:
        done_before = read_logs(args.out)
        parts = zip(recordings, part_of(recordings, len(points), args.shard), strict=True)
        parts_of_shard = {recording: part for recording, part in parts if part}
        hashes: dict[Path, str] = {}
        failures: list[dict[str, object]] = []
        of_files = Pool(futures.ThreadPoolExecutor, args.workers)
        if args.scheduler is not None:
            of_files = cluster_pool(args.scheduler, len(parts_of_shard))
        hashing = of_files.run(sha256_of, parts_of_shard)
        for hashed in show_progress(hashing, 'hashing', len(parts_of_shard)):
            if hashed.result is not None:
                hashes[hashed.job] = hashed.result
            else:
                failures.append(_failed(hashed.job, hashed.failure))
        jobs = [
            make_job(
                replace(requests[number], recording=recording), hashes[recording], points[number]
            )
            for recording, part in parts_of_shard.items()
            if recording in hashes
            for number in part
        ]
        left: dict[str, Job] = {}
        for job in jobs:
            line = done_before.get(job.run_id)
            files = [] if line is None else [line[kind] for kind in wanted if wanted[kind]]
            if line is not None and all(file and (args.out / file).is_file() for file in files):
                continue
            # Of recordings that are the same, the first stands for all.
            first = left.setdefault(job.run_id, job)
            if first is not job:
                logger.warning('%s is the same as %s.', job.recording, first.recording)
        try:
            out = args.out.absolute()
            work = partial(do, out, args.reports, args.trajectories, __version__)
            for ended in show_progress(pool.run(work, left.values()), 'running', len(left)):
                if ended.result is not None:
                    append(ended.result)
                else:
                    failures.append(_failed(ended.job.recording, ended.failure, ended.job))
        except KeyboardInterrupt:
            show_message('warning', 'Stopped; the same command goes on from here.')
            raise
        finally:
            if failures:
                with unfinished_file(failed_file) as file:
                    file.writelines(json_text(failure) + '\n' for failure in failures)
            else:
                failed_file.unlink(missing_ok=True)
            with muted_warnings():  # which were shown before
                lines = read_logs(args.out)
            write_index(args.out, lines, args.score)
    runs = len({job.run_id for job in jobs})
    counts = {'runs': runs, 'done_before': runs - len(left), 'failed': len(failures)}
    index = {'index': str(args.out / INDEX)}
    if args.json:
        print_json({**counts, **index})
    else:
        rows = {name.replace('_', ' '): str(count) for name, count in counts.items()}
        print_table(str(args.out), rows | index)
    if failures:
        failed = f'{len(failures)} run{"s" * (len(failures) != 1)} failed'
        raise IncompleteError(f'{failed}, see {failed_file}; the same command tries again')


def _worker_count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"a number of processes from 1 is needed, not '{text}'")
    return int(text)


def _make_folders(args: argparse.Namespace) -> None:
    """Make the directories of the outputs, whose files must not be in the way either."""
    wanted = {REPORTS: args.reports, TRAJECTORIES: args.trajectories}
    folders = [args.out / name for name, is_wanted in wanted.items() if is_wanted]
    for folder in (args.out, *folders):
        check_directory(folder)
        with failing(OutputError, f"can't make the directory {folder}"):
            folder.mkdir(exist_ok=True)
    for file in (*(log_name(kind, args.shard) for kind in ('runs', 'failed')), INDEX):
        destination(args.out / file)


def _failed(recording: Path, reason: str, job: Job | None = None) -> dict[str, object]:
    logger.warning('%s failed: %s', recording, reason)
    run = {} if job is None else {'run': job.run_id, 'grid': job.point}
    return {'recording': str(recording), 'error': reason, **run}


def find_recordings(patterns: Iterable[str]) -> list[Path]:
    """Return the recordings that paths and patterns name, each once; ``**`` is any folders."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        paths = [pattern]
        if not Path(pattern).exists():
            paths = glob.glob(pattern, recursive=True)  # noqa: PTH207 (it may begin with /)
        if not paths:
            raise UsageError(f"no file is named '{pattern}'")
        found |= dict.fromkeys(Path(path) for path in sorted(paths))
    return list(found)


def grid_points(texts: Iterable[str]) -> list[Point]:
    """Return every combination of the values of ``--grid NAME=VALUE,VALUE…``."""
    axes: dict[str, list[Value]] = {}
    for text in texts:
        name, equals, values = text.partition('=')
        if not (name and equals and values):
            raise UsageError(f"--grid takes NAME=VALUE,VALUE…, not '{text}'")
        if name not in _KNOWN:
            raise UsageError(f"--grid: unknown parameter '{name}'{suggestion(name, _KNOWN)}")
        if name in axes:
            raise UsageError(f'--grid {name} is given twice')
        # Not at the commas of a [list]
        axes[name] = [
            _KNOWN[name].check(parse_value(value)) for value in re.split(r',(?![^\[]*\])', values)
        ]
        for number, value in enumerate(axes[name]):
            if value in axes[name][:number]:
                raise UsageError(f'--grid {name}: {shown(value)} is given twice')
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def shard_of(text: str) -> tuple[int, int]:
    """Take ``i/N``, 1 ≤ i ≤ N, as an argparse type."""
    found = re.fullmatch(r'(\d{1,6})/(\d{1,6})', text)
    number, count = (int(word) for word in found.groups()) if found else (0, 0)
    if not 1 <= number <= count:
        raise argparse.ArgumentTypeError(f"a shard is i/N with i from 1 to N, not '{text}'")
    return number, count


def part_of(recordings: Sequence[Path], points: int, shard: tuple[int, int]) -> list[range]:
    """Return a shard's points of each recording: runs in a row, as it then reads few files."""
    number, count = shard
    total = len(recordings) * points
    first, last = ((number - 1) * total // count, number * total // count)
    starts = range(0, total, points)
    return [range(max(first - at, 0), min(max(last - at, 0), points)) for at in starts]


def make_job(request: Request, sha256: str, point: Point) -> Job:
    """Return the job of one recording at one point, whose values the request has."""
    maps = [] if request.load_map is None else map_files(request.load_map)
    map_bytes = b''.join(not_special(path).read_bytes() for path in maps)
    settings, inputs = (
        {name: getattr(of, name) for name in changed_names(of)}
        for of in (request.settings, request.inputs)
    )
    depends_on = {
        'recording': sha256,
        'version': __version__,
        'settings': settings,
        'inputs': inputs,
        'topics': dataclasses.astuple(request.topics),
        'map': hashlib.sha256(map_bytes).hexdigest() if maps else None,
        'smooth': request.smooth,
    }
    text = json.dumps(depends_on, sort_keys=True).encode()
    return Job(hashlib.sha256(text).hexdigest()[:_ID_DIGITS], sha256, point, request)


_NEEDED = {
    **dict.fromkeys(('run', 'recording', 'recording_sha256', 'version'), str),
    'settings': dict, 'grid': dict, 'warnings': list,
}  # fmt: skip


def log_name(kind: str, shard: tuple[int, int]) -> str:
    """Return the name of a shard's file: of ``runs`` that are done, or have ``failed``."""
    number, count = shard
    return f'{kind}.jsonl' if count == 1 else f'{kind}-{number}-of-{count}.jsonl'


def read_logs(directory: Path) -> dict[str, Line]:
    """Return the lines of all files in a directory, by their runs; warn of what is no run.

    What was run again, for files that were not asked for at first, has the files of all its lines.
    """
    lines: dict[str, Line] = {}
    for file in sorted(directory.glob('runs*.jsonl')):
        for line in _runs_of(file) if file.is_file() else ():
            before = lines.get(line['run'], {})
            files = {kind: line.get(kind) or before.get(kind) for kind in FILES}
            lines[line['run']] = line | files
    return lines


@contextmanager
def opened_log(path: Path) -> Iterator[Callable[[Mapping[str, object]], None]]:
    """Give a function that appends a line, in one piece; it is on the disk when that returns.

    An OutputError is raised if another batch is writing to the file, or a line can't be written.
    """
    with path.open('a+b', buffering=0) as file:  # what does not fit is not tried again at the end
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(f'{path}: another batch is writing to it') from error
        file.seek(0)
        end = file.read().rpartition(b'\n')[2]
        if end and _parsed(end):  # an editor has left out the end of the last line
            file.write(b'\n')
        else:  # a power cut has: that run is to be done again
            file.seek(-len(end), os.SEEK_END)
            file.truncate()

        def append(line: Mapping[str, object]) -> None:
            left = json_text(line).encode() + b'\n'
            with failing(OutputError, f"can't write {path}"):
                while left:
                    left = left[file.write(left) :]
                os.fsync(file.fileno())

        yield append


def _runs_of(path: Path) -> Iterator[Line]:
    """Give the lines of a file that are runs; what follows the last end of a line is none yet."""
    faults: list[str] = []
    for number, text in enumerate(path.read_bytes().rpartition(b'\n')[0].splitlines(), 1):
        line = _parsed(text)
        if fault := _fault_of(line):
            faults.append(f'line {number}: {fault}')
        else:
            yield line
    if faults:
        logger.warning(
            '%s: %d lines are no runs of a batch, and left out (%s).', path, len(faults), faults[0]
        )


def _parsed(text: bytes) -> Any:
    """Return what a line says, None if it is no JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _fault_of(line: object) -> str:
    """Return why a line is none of a run, as the index reads it; '' if it is one."""
    if not isinstance(line, dict):
        return 'no JSON object'
    for name, kind in _NEEDED.items():
        if not isinstance(line.get(name), kind):
            return f"it has no '{name}' as a run has"
    if not all(isinstance(warning, str) for warning in line['warnings']):
        return 'a warning is no text'
    for name in FIGURES:
        value = line.get(name)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if value is not None and not (is_number and abs(value) <= sys.float_info.max):
            return f"'{name}' is no number"
    wrong = [kind for kind in FILES if not isinstance(line.get(kind), str | None)]
    return f"'{wrong[0]}' is no file" if wrong else ''


CONNECT_S = 10.0  # how long the scheduler of a cluster may take to answer

_Job = TypeVar('_Job')
_Result = TypeVar('_Result')
_OpenExecutor = Callable[[int], AbstractContextManager[futures.Executor]]


@dataclass(frozen=True, slots=True)
class Ended(Generic[_Job, _Result]):
    """A job that has ended: with a result, or else with the reason why there is none."""

    job: _Job
    result: _Result | None
    failure: str = ''


@dataclass(frozen=True, slots=True)
class Pool:
    """Does jobs, at most ``width`` at a time."""

    open_executor: _OpenExecutor
    width: int

    def run(
        self, work: Callable[[_Job], _Result], jobs: Iterable[_Job]
    ) -> Iterator[Ended[_Job, _Result]]:
        """Do jobs; yield each when it has ended. Jobs that run when the caller stops are lost."""
        waiting = deque(jobs)
        while waiting:
            suspects: list[_Job] = []
            with self.open_executor(min(self.width, len(waiting))) as executor:
                running: dict[futures.Future[_Result], _Job] = {}
                while running or (waiting and not suspects):
                    while waiting and not suspects and len(running) < self.width:
                        # Ctrl-C is held back until processes that begin are prepared for it.
                        held_before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
                        try:
                            running[executor.submit(work, waiting[0])] = waiting[0]
                        except futures.BrokenExecutor:
                            break
                        finally:
                            signal.pthread_sigmask(signal.SIG_SETMASK, held_before)
                        waiting.popleft()
                    if not running:
                        break
                    done, _ = futures.wait(running, return_when=futures.FIRST_COMPLETED)
                    for future in done:
                        job = running.pop(future)
                        ended = _ended(job, future)
                        if ended is None:
                            suspects.append(job)
                        else:
                            yield ended
            # A process has died. Which job's fault that was shows when each runs alone.
            for job in suspects:
                if self.width == 1:
                    yield Ended(job, None, 'its process died: killed, or out of memory')
                else:
                    yield from Pool(self.open_executor, 1).run(work, [job])


def _ended(job: _Job, future: futures.Future[_Result]) -> Ended[_Job, _Result] | None:
    """Return how a job has ended; None if a process died, its own or another one."""
    try:
        return Ended(job, future.result())
    except futures.BrokenExecutor:
        return None
    except (SlamObserverError, OSError) as error:
        return Ended(job, None, message_of(error))
    except futures.CancelledError:
        return Ended(job, None, 'cancelled: the scheduler is gone')
    except Exception as error:  # noqa: BLE001 (of whatever kind: the other runs are to be done)
        return Ended(job, None, f'{type(error).__name__}: {" ".join(str(error).split())}')


def local_pool(workers: int) -> Pool:
    """Return a pool of processes of this machine."""
    return Pool(_processes, workers)


def cluster_pool(address: str, jobs: int) -> Pool:
    """Return a pool of a Dask scheduler's workers; a UsageError if none answers there."""
    with _cluster(address, jobs):
        pass
    return Pool(partial(_cluster, address), jobs)


@contextmanager
def _processes(count: int) -> Iterator[futures.Executor]:
    others = set(multiprocessing.active_children())
    executor = futures.ProcessPoolExecutor(
        count, multiprocessing.get_context('spawn'), initializer=_prepare_process
    )
    is_done = False
    try:
        yield executor
        is_done = True
    finally:
        if not is_done:  # Ctrl-C: what runs now is not waited for
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
        executor.shutdown(wait=True, cancel_futures=True)


def _prepare_process() -> None:
    """Leave Ctrl-C to the batch, and end with it, also when it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if (parent := multiprocessing.parent_process()) is not None:

        def end_with_parent() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def _cluster(address: str, _: int) -> Iterator[futures.Executor]:
    try:
        from distributed import Client
        from distributed.cfexecutor import ClientExecutor
        from distributed.comm import connect
        from distributed.security import Security
    except ImportError as error:
        raise UsageError(
            "--scheduler needs Dask: pip install 'slam_observer_ros[cluster]'"
        ) from error

    async def try_to_connect() -> None:
        options = Security().get_connection_args('client')
        await (await connect(address, CONNECT_S, **options)).close()

    try:
        # A client that has failed would try to close its connection when the program ends.
        asyncio.run(asyncio.wait_for(try_to_connect(), CONNECT_S))
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except Exception as error:  # of any kind, as what an address is depends on its protocol
        reason = f': {error}' if str(error) else ''
        raise UsageError(
            f'--scheduler {address}: no Dask scheduler answers there{reason}'
        ) from error
    with client:
        executor: futures.Executor = ClientExecutor(client, pure=False)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)  # nothing runs any more, or it is not to
