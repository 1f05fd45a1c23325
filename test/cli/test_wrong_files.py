"""Names that are empty, files that block or lead in a circle, and outputs onto inputs."""

from __future__ import annotations

import errno
import os
from pathlib import Path
import shutil

import pytest
from recordings import SAMPLE


@pytest.fixture(name='slam_observer')
def fixture_slam_observer(slam_observer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return slam_observer


@pytest.fixture(name='recording')
def fixture_recording(tmp_path):
    return Path(shutil.copy(SAMPLE, tmp_path / 'run.mcap'))


READ = [
    ('replay', '{}.mcap'),
    ('replay', 'run.mcap', '--config', '{}.yaml'),
    ('replay', 'run.mcap', '--load-map', '{}.yaml'),
    ('replay', 'folder'),
    ('convert', 'tum', '{}.mcap', 'out.tum'),
    ('calibrate', '{}.bag', '--only', 'noise'),
    ('map', 'convert', '{}.csv', 'out.yaml'),
    ('map', 'convert', '{}.yaml', 'out.yaml'),
    ('map', 'convert', '{}.json', 'out.yaml'),
    ('map', 'check', '{}.yaml'),
    ('convert', 'starry-night', '{}.mat', 'out.mcap'),
    ('convert', 'graph', '{}.txt', 'out.mcap'),
    ('config', './{}.yaml'),
    ('config', './{}.yaml', '--dump'),
    ('doctor', '{}.mcap'),
]
"""What reads a file, by its name without a suffix; a folder has it as its only file."""


@pytest.mark.timeout(60)
@pytest.mark.parametrize('words', READ, ids=' '.join)
def test_a_pipe_is_refused_and_not_waited_for(slam_observer, recording, words):
    words = [word.format('pipe') for word in words]
    pipe = next((Path(word) for word in words if 'pipe' in word), Path('folder/a.mcap'))
    pipe.parent.mkdir(exist_ok=True)
    os.mkfifo(pipe)
    error = slam_observer.fail(*words)
    assert 'it is no regular file' in error
    assert str(pipe) in error
    assert '[Errno' not in error


@pytest.mark.parametrize('suffix', ['mcap', 'db3', 'bag'])
def test_a_file_that_may_not_be_read_is_named_with_the_reason(slam_observer, monkeypatch, suffix):
    def refuse(path, *_args, **_options):
        raise PermissionError(errno.EACCES, 'Permission denied', str(path))

    path = Path(f'run.{suffix}')
    path.write_text('text')
    monkeypatch.setattr(Path, 'open', refuse)  # root may read anything
    said = f'slam-observer: error: {path}: can not be read: Permission denied\n'
    assert slam_observer.fail('replay', path) == said


@pytest.mark.parametrize('words', [*READ[:3], *READ[4:]], ids=' '.join)
def test_a_link_to_itself_is_named(slam_observer, recording, words):
    words = [word.format('circle') for word in words]
    circle = Path(next(word for word in words if 'circle' in word))
    circle.symlink_to(circle.name)
    error = slam_observer.fail(*words)
    assert str(circle) in error
    assert 'symbolic links' in error
    assert '[Errno' not in error


@pytest.mark.parametrize('option', ['--tum', '--map', '--report'])
def test_an_output_that_links_to_itself_is_refused(slam_observer, recording, option):
    circle = Path('circle')
    circle.symlink_to(circle)
    error = slam_observer.fail('replay', recording, '--force', option, circle)
    assert 'circle is' in error
    assert circle.is_symlink()


@pytest.mark.parametrize(
    'words',
    [
        ('replay', ''),
        ('replay', 'run.mcap', '--tum', ''),
        ('replay', 'run.mcap', '--config', ''),
        ('replay', 'run.mcap', '--load-map', ''),
        ('replay', 'run.mcap', '--landmarks-topic', ''),
        ('replay', 'run.mcap', '--base-frame', ''),
        ('convert', 'tum', '', 'out.tum'),
        ('convert', 'tum', 'run.mcap', ''),
        ('calibrate', 'run.mcap', '--hold-out', ''),
        ('batch', '', '--out', 'out'),
        ('batch', 'run.mcap', '--out', ''),
        ('map', 'convert', '', 'out.yaml'),
        ('map', 'convert', 'a.csv', 'out.yaml', '--frame', ''),
        ('map', 'check', ''),
        ('convert', 'mrclam', '', 'out.mcap', '--robot', '1'),
        ('config', ''),
        ('doctor', ''),
    ],
    ids=' '.join,
)
def test_an_empty_name_is_refused(slam_observer, recording, tmp_path, words):
    assert 'the name is empty' in slam_observer.fail(*words)
    assert list(tmp_path.iterdir()) == [recording]


def test_a_batch_says_why_its_directory_can_not_be(slam_observer, recording):
    batch = ('batch', recording, '--out')
    assert 'run.mcap is no directory' in slam_observer.fail(*batch, 'run.mcap')
    assert 'there is no directory nowhere' in slam_observer.fail(*batch, 'nowhere/out')
    assert "can't make the directory /proc/x" in slam_observer.fail(*batch, '/proc/x')


@pytest.mark.parametrize('name', ['runs.jsonl', 'failed.jsonl', 'index.html', 'reports'])
def test_what_is_in_the_way_of_a_batch_is_said_before_the_first_run(
    slam_observer, recording, name
):
    in_the_way = Path('out') / name
    in_the_way.parent.mkdir()
    if name == 'reports':
        in_the_way.write_text('')
    else:
        in_the_way.mkdir()
    error = slam_observer.fail('batch', recording, '--out', 'out', '--reports')
    assert f'{in_the_way}' in error
    assert '[Errno' not in error
    assert not [file for file in Path('out').rglob('*') if file.is_file() and file != in_the_way]


@pytest.mark.parametrize(
    'words',
    [
        ('replay', 'run.mcap', '--tum', 'link.png'),
        ('replay', 'run.mcap', '--mcap', 'run.mcap'),
        ('convert', 'tum', 'run.mcap', 'link.png'),
        ('calibrate', 'run.mcap', '--only', 'noise', '--out', 'link.png'),
        ('calibrate', 'other.mcap', '--hold-out', 'run.mcap', '--out', 'run.mcap'),
        ('convert', 'starry-night', 'run.mcap', 'run.mcap'),
        ('convert', 'graph', 'run.yaml', 'run.mcap'),
        ('map', 'convert', 'run.mcap', 'link.png'),
        ('map', 'check', 'run.mcap', '--plot', 'link.png'),
    ],
    ids=' '.join,
)
def test_no_output_replaces_what_is_read_even_by_force(slam_observer, recording, words):
    for link in (Path('link.png'), Path('run.yaml')):
        link.symlink_to(recording)
    assert 'would replace' in slam_observer.fail(*words, '--force')
    assert recording.read_bytes() == SAMPLE.read_bytes()


def test_a_folder_of_figures_is_no_other_output(slam_observer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ('simulate', '--output', 'a.mcap', '--plot', './a.mcap', '--force')
    assert 'is named for two outputs' in slam_observer.fail(*words)
    assert not Path('a.mcap').exists()


@pytest.mark.parametrize('only', [(), ('--only', 'noise')])
def test_what_is_held_out_is_read_before_the_search(slam_observer, recording, monkeypatch, only):
    for search in ('find_noise', 'CalibrationFinder'):
        monkeypatch.setattr(f'slam_observer_ros.cli.calibrate.{search}', None)
    words = ('calibrate', recording, *only, '--hold-out')
    assert 'nothing.mcap: no such file' in slam_observer.fail(*words, 'nothing.mcap')
    assert 'a recording is given twice' in slam_observer.fail(*words, SAMPLE)
