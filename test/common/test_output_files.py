"""Output files appear whole or not at all, over regular files only, whoever else is around."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

from slam_observer_ros.common.files import (
    destination,
    unfinished_directory,
    unfinished_file,
)

WRITE_AND_WAIT = """\
from pathlib import Path
import sys
from slam_observer_ros.common.files import unfinished_directory, unfinished_file
folder = Path(sys.argv[1])
with unfinished_file(folder / 'map.yaml') as file, unfinished_directory(folder) as directory:
    file.write('half')
    file.flush()
    (directory / 'figure.png').write_text('half')
    print('writing', flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def writer(tmp_path):
    """Run a process that is writing a file and a directory."""
    with subprocess.Popen(
        [sys.executable, '-c', WRITE_AND_WAIT, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout.readline() == b'writing\n'
        yield process
        process.kill()


def write(path, text='new'):
    with unfinished_file(path) as file:
        file.write(text)


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_a_file_replaces_an_older_one_whole_and_nothing_else_is_left(tmp_path):
    for text in ('old', 'new'):
        write(tmp_path / 'map.yaml', text)
    assert (tmp_path / 'map.yaml').read_text() == 'new'
    assert names(tmp_path) == ['map.yaml']


def test_after_an_error_the_older_file_is_there_and_nothing_else(tmp_path):
    write(tmp_path / 'map.yaml', 'old')
    with (
        pytest.raises(ValueError, match='of the caller'),
        unfinished_file(tmp_path / 'map.yaml') as file,
    ):
        file.write('new')
        raise ValueError('of the caller')
    assert (tmp_path / 'map.yaml').read_text() == 'old'
    assert names(tmp_path) == ['map.yaml']


def test_links_that_others_have_put_beside_a_file_are_not_followed(tmp_path):
    victim, folder = tmp_path / 'victim', tmp_path / 'shared'
    victim.write_text('precious')
    folder.mkdir()
    guess = folder / f'.map.yaml.{os.getpid()}'
    guess.symlink_to(victim)
    write(folder / 'map.yaml')
    assert victim.read_text() == 'precious'
    assert not (folder / 'map.yaml').is_symlink()


def test_a_file_has_the_permissions_that_new_files_have(tmp_path):
    write(tmp_path / 'map.yaml')
    (tmp_path / 'other').touch()
    assert (tmp_path / 'map.yaml').stat().st_mode == (tmp_path / 'other').stat().st_mode


def test_what_a_killed_process_has_left_is_removed_by_the_next(tmp_path, writer):
    writer.kill()
    writer.wait()
    assert len(names(tmp_path)) == 2
    write(tmp_path / 'map.yaml')
    with unfinished_directory(tmp_path):
        pass
    assert names(tmp_path) == ['map.yaml']


def test_what_another_process_is_writing_is_left_alone(tmp_path, writer):
    before = names(tmp_path)
    write(tmp_path / 'map.yaml')
    with unfinished_directory(tmp_path):
        pass
    assert names(tmp_path) == sorted([*before, 'map.yaml'])
    writer.communicate()
    assert writer.returncode == 0
    assert (tmp_path / 'map.yaml').read_text() == 'half'
    assert names(tmp_path) == ['map.yaml']


@pytest.mark.parametrize('make', [os.mkfifo, os.mkdir, lambda path: path.symlink_to(path)])
def test_what_is_no_regular_file_is_refused(tmp_path, make):
    path = tmp_path / 'map.yaml'
    make(path)
    with pytest.raises(OSError, match=r'no regular file|symbolic links'):
        destination(path)
    with pytest.raises(OSError, match=r'no regular file|symbolic links'):
        write(path)
    assert names(tmp_path) == ['map.yaml']


def test_a_link_to_a_file_stays_and_the_file_is_replaced(tmp_path):
    (tmp_path / 'link').symlink_to(tmp_path / 'map.yaml')
    write(tmp_path / 'link')
    assert Path(tmp_path / 'link').is_symlink()
    assert (tmp_path / 'map.yaml').read_text() == 'new'
