"""Where the runs of a batch are done: in processes of this machine, or on a Dask cluster.

Both are executors of ``concurrent.futures``, so there is one way through.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
import multiprocessing
import os
import signal
import threading
from typing import Generic, TypeVar

from slam_observer_ros.common.errors import message_of, SlamObserverError, UsageError

CONNECT_S = 10.0
"""How long the scheduler of a cluster may take to answer."""

_Job = TypeVar('_Job')
_Result = TypeVar('_Result')
_OpenExecutor = Callable[[int], AbstractContextManager[Executor]]


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
                yield from self._run(executor, work, waiting, suspects)
            # A process has died. Which job's fault that was shows when each runs alone.
            for job in suspects:
                if self.width == 1:
                    yield Ended(job, None, 'its process died: killed, or out of memory')
                else:
                    yield from Pool(self.open_executor, 1).run(work, [job])

    def _run(
        self,
        executor: Executor,
        work: Callable[[_Job], _Result],
        waiting: deque[_Job],
        suspects: list[_Job],
    ) -> Iterator[Ended[_Job, _Result]]:
        """Do jobs until none waits, or a process dies: then ``suspects`` are those it may be."""
        running: dict[Future[_Result], _Job] = {}
        while running or (waiting and not suspects):
            while waiting and not suspects and len(running) < self.width:
                try:
                    with _ctrl_c_held_back():
                        running[executor.submit(work, waiting[0])] = waiting[0]
                except BrokenExecutor:
                    break
                waiting.popleft()
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                job = running.pop(future)
                if not future.cancelled() and isinstance(future.exception(), BrokenExecutor):
                    suspects.append(job)
                else:
                    yield _ended(job, future)


def _ended(job: _Job, future: Future[_Result]) -> Ended[_Job, _Result]:
    try:
        return Ended(job, future.result())
    except (SlamObserverError, OSError) as error:
        return Ended(job, None, message_of(error))
    except CancelledError:
        return Ended(job, None, 'cancelled: the scheduler is gone')
    except Exception as error:  # noqa: BLE001 (of whatever kind: the other runs are to be done)
        return Ended(job, None, f'{type(error).__name__}: {" ".join(str(error).split())}')


def local_pool(workers: int) -> Pool:
    """Return a pool of processes of this machine."""
    return Pool(_processes, workers)


def cluster_pool(address: str, jobs: int) -> Pool:
    """Return a pool of a Dask scheduler's workers, which share out all jobs among them.

    Raises a UsageError if no scheduler answers there.
    """
    with _cluster(address, jobs):
        pass
    return Pool(partial(_cluster, address), jobs)


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    others = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(
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


@contextmanager
def _ctrl_c_held_back() -> Iterator[None]:
    """Hold Ctrl-C back, also from processes that begin here, until they are prepared for it."""
    held_before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held_before)


def _prepare_process() -> None:
    """Leave Ctrl-C to the batch, and end with it, also when it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.join,), daemon=True).start()


def _end_with(wait_for_parent: Callable[[], None]) -> None:
    wait_for_parent()
    os._exit(1)


@contextmanager
def _cluster(address: str, _: int) -> Iterator[Executor]:
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
        executor: Executor = ClientExecutor(client, pure=False)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)  # nothing runs any more, or it is not to
