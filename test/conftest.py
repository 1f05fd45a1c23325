"""What all tests share: recordings, a ROS domain of their own, and a check for leftovers."""

from __future__ import annotations

import atexit
from collections.abc import Iterator
from contextlib import suppress
import logging
import os
from pathlib import Path
import shutil
import signal
import socket
import sys
import tempfile
import time
from typing import TYPE_CHECKING

from command_line import CommandLine
from hypothesis import settings
import pytest

from slam_observer_ros.common.process import use_one_thread

if TYPE_CHECKING:
    from node_processes import Client

CHECKOUT = Path(__file__).resolve().parents[1]
SESSION_VARIABLE = 'SLAM_OBSERVER_TEST_SESSION'
# The ports of higher domain ids overlap those that Linux hands out to clients.
DOMAIN_IDS = range(1, 102)
SHARED_MEMORY = Path('/dev/shm')
DDS_FILES = '*fastrtps_*'

MAPPED_S = 2.0
"""Longest time that a process takes to map shared memory that it has made."""

SCRATCH = Path(tempfile.mkdtemp(prefix='slam_observer_test_'))
atexit.register(shutil.rmtree, SCRATCH)

# Set at import, so that child processes and fixtures of any scope see them.
os.environ[SESSION_VARIABLE] = str(os.getpid())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
# UDP alone, where rmw_fastrtps leaves the choice: with LOCALHOST it adds shared memory itself.
os.environ['FASTDDS_BUILTIN_TRANSPORTS'] = 'UDPv4'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['TMPDIR'] = str(SCRATCH)  # of processes alone: this one has chosen its own already
os.environ['ROS_LOG_DIR'] = str(SCRATCH)
os.environ['HYPOTHESIS_STORAGE_DIRECTORY'] = str(SCRATCH)
os.environ['MPLBACKEND'] = 'Agg'

# A background job of a shell ignores Ctrl-C, and so would all programs that the tests stop by it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# As the programs do, and before numpy is loaded: tests take ten times longer otherwise.
use_one_thread()

# The same examples everywhere, so that a failure can be repeated by whoever reads of it; and no
# deadline: no test may depend on how busy the machine is.
settings.register_profile('suite', derandomize=True, deadline=None, max_examples=15)
settings.load_profile('suite')


LONGEST = (
    'test_mistakes',
    'test_real_recordings',
    'test_association',
    'test_named_mistakes',
    'test_map_replay',
    'test_report',
    'test_slip',
    'test_live_settings',
    'test_batch_cluster',
    'test_found_without_ids',
    'test_ament_style',
    'test_cli_simulate',
    'test_noise_search',
    'test_replay_inputs',
    'test_batch',
    'test_cli_usage',
)
"""Files that take longest, of those without nodes: they begin early, so that none ends alone."""

WAITING_SHARE = 0.8
"""Part of a session within which all files with nodes begin."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Spread the files that start nodes, which mostly wait, among those that compute."""
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    waiting = [f for f in files if any(item.get_closest_marker('ros') for item in files[f])]
    computing = [path for path in files if path not in waiting]
    computing.sort(key=lambda path: LONGEST.index(path.stem) if path.stem in LONGEST else 99)
    places = {path: WAITING_SHARE * n / len(waiting) for n, path in enumerate(waiting)}
    places |= {path: n / len(computing) for n, path in enumerate(computing)}
    items[:] = [item for path in sorted(files, key=places.__getitem__) for item in files[path]]


@pytest.fixture(scope='session')
def data_dir() -> Path:
    """Folder of the public recordings; tests that need it are skipped where there is none."""
    path = Path(os.environ.get('SLAM_OBSERVER_DATA', CHECKOUT.parent / 'shared' / 'data'))
    if not path.is_dir():
        pytest.skip(f'no recordings in {path}: SLAM_OBSERVER_DATA names their folder')
    return path


@pytest.fixture
def slam_observer(capsys: pytest.CaptureFixture[str]) -> CommandLine:
    """Run ``slam-observer`` in the test's process."""
    return CommandLine(capsys)


@pytest.fixture(scope='module', autouse=True)
def ros_domain_id() -> Iterator[int]:
    """Give each test module a ROS_DOMAIN_ID that no other test on this machine uses."""
    with socket.socket(socket.AF_UNIX) as reservation, pytest.MonkeyPatch.context() as patch:
        domain_id = next(i for i in DOMAIN_IDS if reserve(reservation, i))
        patch.setenv('ROS_DOMAIN_ID', str(domain_id))
        yield domain_id


@pytest.fixture(scope='module', autouse=True)
def log_as_before() -> Iterator[None]:
    """Take back what a module's nodes and libraries have made of the log's levels."""
    loggers = [logging.getLogger(name) for name in (None, 'slam_observer_ros')]
    before = [(logger.level, [*logger.handlers]) for logger in loggers]
    yield
    for logger, (level, handlers) in zip(loggers, before, strict=True):
        logger.setLevel(level)
        logger.handlers = handlers


@pytest.fixture(scope='module')
def ros(ros_domain_id: int) -> Iterator[Client]:
    """Listen and talk to nodes in the module's domain."""
    from node_processes import client  # rclpy, which tests without nodes can do without

    with client() as opened:
        yield opened


def reserve(reservation: socket.socket, domain_id: int) -> bool:
    """Bind an abstract socket, which the kernel frees even if this process is killed."""
    try:
        reservation.bind(f'\0slam_observer_ros_domain_{domain_id}')
    except OSError:
        return False
    return True


@pytest.fixture(scope='session', autouse=True)
def nothing_is_left_behind() -> Iterator[None]:
    """Fail when a process outlives the tests, and end it; clear away what killed nodes leave."""
    before = set(SHARED_MEMORY.glob(DDS_FILES))
    yield
    if 'node_processes' in sys.modules:
        sys.modules['node_processes'].FORKS.end()
    processes = processes_of_these_tests()
    for process_id in processes:
        os.kill(process_id, signal.SIGKILL)
    left = unused_files() - before
    if left:
        # A node of other tests may be about to map what it has just made: it would be deaf.
        time.sleep(MAPPED_S)
        left &= unused_files()
    for file in left:
        file.unlink(missing_ok=True)
    assert not processes, f'processes left running: {list(processes.values())}'


def unused_files() -> set[Path]:
    """Return this user's files of shared memory that no process has mapped."""
    files = set(SHARED_MEMORY.glob(DDS_FILES))
    used = segments_in_use()  # after the files: one that comes meanwhile would seem unused
    unused = set()
    for file in files:
        with suppress(FileNotFoundError):  # its process has removed it meanwhile
            # Another user's processes can't be looked into.
            if segment_of(file.name) not in used and file.stat().st_uid == os.getuid():
                unused.add(file)
    return unused


def segments_in_use() -> set[str]:
    """Return the names of the segments of shared memory that any process has mapped."""
    used = set()
    for maps in Path('/proc').glob('[0-9]*/maps'):
        try:
            lines = maps.read_text().splitlines()
        except (ProcessLookupError, FileNotFoundError, PermissionError):
            continue  # it has ended meanwhile, or is another user's
        names = (Path(line.split()[-1]).name for line in lines if str(SHARED_MEMORY) in line)
        used |= {segment_of(name) for name in names}
    return used


def segment_of(name: str) -> str:
    """Return the name of the segment that a file is, or is the lock or the semaphore of."""
    return name.removeprefix('sem.').removesuffix('_mutex').removesuffix('_el')


def processes_of_these_tests() -> dict[int, str]:
    """Command lines of all processes that the tests started, orphans too, by process id."""
    mark = f'{SESSION_VARIABLE}={os.getpid()}\0'.encode()
    found = {}
    for folder in Path('/proc').glob('[0-9]*'):
        try:
            if mark in (folder / 'environ').read_bytes() and int(folder.name) != os.getpid():
                command = (folder / 'cmdline').read_bytes()
                if b'multiprocessing.resource_tracker' not in command:  # that ends with its parent
                    found[int(folder.name)] = command.replace(b'\0', b' ').decode()
        except (ProcessLookupError, FileNotFoundError, PermissionError):
            continue  # it has ended meanwhile, or is another user's
    return found
