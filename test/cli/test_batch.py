"""A batch: every run once, whatever stops it, and a page that compares them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
import json
import math
import os
from pathlib import Path
import re
import resource
import signal
import subprocess
import sys
import time

from browser import open_page
import numpy as np
import pytest
from recordings import events, write_mcap, write_rosbag1

from slam_observer_ros.cli.batch import grid_points, local_pool, opened_log, part_of, read_logs
from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.report.page import write_index
from slam_observer_ros.report.summary import FIGURES

PATIENCE_S = 60.0
RUN = {
    'run': 'a',
    'recording': 'one.mcap',
    'recording_sha256': '0',
    'version': '1',
    'settings': {},
    'grid': {},
    'warnings': [],
}
"""What a line has at least."""
GRID = ('--grid', 'point_noise=0.02,0.05', '--grid', 'observation_model=cartesian')
in_this_process = pytest.mark.usefixtures('no_processes')


@pytest.fixture(name='recordings')
def fixture_recordings(tmp_path):
    """Two recordings of different content."""
    folder = tmp_path / 'recordings' / 'monday'
    folder.mkdir(parents=True)
    return [write_mcap(folder / 'one.mcap'), write_rosbag1(folder / 'two.bag')]


def test_a_line_that_does_not_fit_on_the_disk_is_an_error_that_names_the_file(tmp_path):
    path = tmp_path / 'runs.jsonl'
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40, limits[1]))
    try:
        with (
            pytest.raises(OutputError, match=r"can't write .*runs\.jsonl: File too large"),
            opened_log(path) as append,
        ):
            append(RUN)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with opened_log(path) as append:
        append(RUN)
    assert list(read_logs(tmp_path)) == ['a']


def lines_of(directory: Path):
    return [
        json.loads(line)
        for file in sorted(directory.glob('runs*.jsonl'))
        for line in file.read_text().splitlines()
    ]


def figures_of(lines):
    """What runs found, without the CPU time that it took."""
    return {line['run']: {**line, 'seconds': None} for line in lines}


def started(*arguments: object):
    """Start the command as a process of its own, and in a group of its own."""
    command = [sys.executable, '-m', 'slam_observer_ros.cli.main', 'batch', *map(str, arguments)]
    return subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True)


def wait_for_lines(directory: Path, count: int, process) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while len(read_logs(directory)) < count:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_every_recording_is_run_with_every_setting(slam_observer, recordings, tmp_path):
    out = tmp_path / 'results'
    pattern = tmp_path / 'recordings' / '**' / '*.*'
    ended = slam_observer.succeed('batch', pattern, *GRID, '--out', out, '--json')
    assert ended.json == {
        'runs': 4,
        'done_before': 0,
        'failed': 0,
        'index': str(out / 'index.html'),
    }
    done = {(line['recording'], line['grid']['point_noise']): line for line in lines_of(out)}
    assert set(done) == {(str(path), noise) for path in recordings for noise in (0.02, 0.05)}
    options = ('--set', 'point_noise=0.05', '--set', 'observation_model=cartesian', '--json')
    alone = slam_observer.succeed('replay', recordings[1], *options).json
    line = done[str(recordings[1]), 0.05]
    assert {name: line[name] for name in alone if name != 'seconds'} == {
        name: value for name, value in alone.items() if name != 'seconds'
    }


@in_this_process
def test_what_is_done_is_not_done_again(slam_observer, recordings, tmp_path):
    out = tmp_path / 'results'
    first = ('batch', recordings[0], '--out', out, '--workers', 1, '--json')
    slam_observer.succeed(*first, '--grid', 'range_noise=0.1,0.2')
    content = (out / 'runs.jsonl').read_bytes()
    again = slam_observer.succeed(*first, '--grid', 'range_noise=0.2,0.1').json
    assert (again['runs'], again['done_before']) == (2, 2)
    assert (out / 'runs.jsonl').read_bytes() == content
    more = slam_observer.succeed(*first, '--grid', 'range_noise=0.2,0.3').json
    assert (more['runs'], more['done_before']) == (2, 1)
    assert (out / 'runs.jsonl').read_bytes().startswith(content)
    # The default, said or not, is one setting.
    assert slam_observer.succeed(*first).json['done_before'] == 1


@in_this_process
def test_a_recording_that_fails_is_listed_and_the_rest_done(
    slam_observer, recordings, beginning, tmp_path
):
    out = tmp_path / 'results'
    bad = tmp_path / 'bad.mcap'
    bad.write_bytes(b'no recording')
    options = ('--out', out, '--workers', 1)
    ended = slam_observer('batch', bad, recordings[0], *options)
    assert ended.code == 4
    assert f'{bad} failed' in ended.errors
    assert [line['recording'] for line in lines_of(out)] == [str(recordings[0])]
    (failure,) = map(json.loads, (out / 'failed.jsonl').read_text().splitlines())
    assert (failure['recording'], failure['grid']) == (str(bad), {})
    bad.write_bytes(beginning.read_bytes())  # now it is one
    slam_observer.succeed('batch', bad, recordings[0], *options)
    assert len(lines_of(out)) == 2
    assert not (out / 'failed.jsonl').exists()


@in_this_process
def test_the_same_recording_under_two_names_is_run_once(slam_observer, recordings, tmp_path):
    copy = tmp_path / 'copy.mcap'
    copy.write_bytes(recordings[0].read_bytes())
    ended = slam_observer('batch', recordings[0], copy, '--out', tmp_path / 'r', '--workers', 1)
    assert ended.code == 0
    assert f'{copy} is the same as {recordings[0]}' in ended.errors
    assert len(lines_of(tmp_path / 'r')) == 1


@pytest.mark.parametrize(
    ('options', 'reason'),
    [
        (['--grid', 'range_nois=0.1'], "did you mean 'range_noise'"),
        (['--grid', 'range_noise=-1'], 'range_noise'),
        (['--grid', 'range_noise'], 'NAME=VALUE,VALUE'),
        (['--grid', 'gains=constant', '--smooth'], '--smooth needs riccati gains'),
        (['--shard', '3/2'], 'i from 1 to N'),
        (['nothing/*.mcap'], "no file is named 'nothing/*.mcap'"),
        (['--grid', 'range_noise=0.1,0.10'], '--grid range_noise: 0.1 is given twice'),
        (['--workers', '0'], 'a number of processes from 1 is needed'),
        (['--workers', 'many'], 'a number of processes from 1 is needed'),
    ],
)
def test_what_can_not_be_run_is_refused_before_anything_is(
    slam_observer, recordings, tmp_path, options, reason
):
    out = tmp_path / 'results'
    assert reason in slam_observer.fail('batch', *options, recordings[0], '--out', out)
    assert not out.exists()


@in_this_process
def test_shards_do_all_runs_once(slam_observer, recordings, tmp_path):
    whole, parts = tmp_path / 'whole', tmp_path / 'parts'
    options = (*recordings, '--grid', 'gains=riccati,constant', '--workers', 1)
    slam_observer.succeed('batch', *options, '--out', whole)
    for number in (1, 2):
        slam_observer.succeed('batch', *options, '--out', parts, '--shard', f'{number}/2')
    assert len(lines_of(parts)) == 4
    assert figures_of(lines_of(parts)) == figures_of(lines_of(whole))
    assert sorted(file.name for file in parts.iterdir()) == [
        'index.html',
        'runs-1-of-2.jsonl',
        'runs-2-of-2.jsonl',
    ]


@pytest.mark.parametrize('count', [1, 3, 7, 50])
def test_shards_have_each_run_once_and_in_a_row(count):
    runs = [
        (recording, point)
        for number in range(1, count + 1)
        for recording, points in enumerate(part_of([Path()] * 5, 9, (number, count)))
        for point in points
    ]
    assert runs == [(recording, point) for recording in range(5) for point in range(9)]


def test_grids_may_have_lists():
    points = grid_points(['linear_velocity_noise=[0,0,1],[0,0,2]', 'gains=riccati,constant'])
    assert [point['linear_velocity_noise'][2] for point in points] == [1.0, 1.0, 2.0, 2.0]
    assert [point['gains'] for point in points] == ['riccati', 'constant'] * 2


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT])
def test_a_batch_that_was_stopped_ends_its_processes_and_goes_on(
    slam_observer, no_processes, beginning, tmp_path, number
):
    out = tmp_path / 'results'
    options = (beginning, '--grid', 'range_noise=0.07,0.08,0.09,0.1,0.11,0.12', '--workers', 2)
    process = started(*options, '--out', out)
    wait_for_lines(out, 1, process)
    os.kill(process.pid, number)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert 'Traceback' not in errors
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert (out / 'index.html').exists()
    deadline = time.monotonic() + PATIENCE_S
    while _is_alive(process.pid):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    done = read_logs(out)
    assert 1 <= len(done) < 6
    with (out / 'runs.jsonl').open('a') as file:
        file.write('{"run": "of a line that a power cut has left')
    slam_observer.succeed('batch', *options, '--out', out)
    lines = lines_of(out)
    assert len(lines) == len({line['run'] for line in lines}) == 6
    assert lines[: len(done)] == list(done.values())


def _is_alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_no_two_batches_write_to_one_file(tmp_path):
    with opened_log(tmp_path / 'runs.jsonl') as append:
        append(RUN)
        with (
            pytest.raises(OutputError, match='another batch'),
            opened_log(tmp_path / 'runs.jsonl'),
        ):
            pass
    assert read_logs(tmp_path)['a'].items() >= RUN.items()


def test_ctrl_c_reaches_no_process_that_begins():
    held_back = partial(signal.pthread_sigmask, signal.SIG_BLOCK)
    (ended,) = local_pool(1).run(held_back, [()])
    assert signal.SIGINT in ended.result
    assert signal.SIGINT not in held_back(())


def test_a_run_that_kills_its_process_stops_no_other():
    jobs = ['0 / 2', '1 / 2', "__import__('os').abort()", '3 / 2', '4 / 0', '5 / 2']
    ended = {one.job: one for one in local_pool(2).run(eval, jobs)}
    assert set(ended) == set(jobs)
    assert 'process died' in ended[jobs[2]].failure
    assert ended[jobs[4]].failure == 'ZeroDivisionError: division by zero'
    assert [ended[job].result for job in jobs if job[4:] == '2'] == [0.0, 0.5, 1.5, 2.5]


@in_this_process
def test_files_that_are_asked_for_later_are_written_later(slam_observer, recordings, tmp_path):
    out = tmp_path / 'results'
    command = ('batch', *recordings, '--out', out, '--workers', 1, '--json')
    slam_observer.succeed(*command)
    assert slam_observer.succeed(*command, '--reports').json['done_before'] == 0
    assert slam_observer.succeed(*command, '--trajectories').json['done_before'] == 0
    both = (*command, '--reports', '--trajectories')
    assert slam_observer.succeed(*both).json['done_before'] == 2
    lines = read_logs(out).values()
    assert len(lines) == 2
    for line in lines:
        assert (out / line['report']).is_file()
        assert (out / line['trajectory']).is_file()
        assert line['report'] in (out / 'index.html').read_text()
    (out / line['report']).unlink()
    assert slam_observer.succeed(*both).json['done_before'] == 1
    assert (out / line['report']).is_file()


@pytest.mark.parametrize(
    'line',
    [
        'null',
        '17',
        '"run"',
        '[]',
        '[{"run": "a"}]',
        '{}',
        '{"run": "a"',
        '{"run": 1}',
        '[' * 100_000,
        '9' * 5000,
        '\0',
        *(json.dumps({**RUN, name: None}) for name in RUN),
        *(json.dumps({**RUN, name: 'x'}) for name in ('settings', 'grid', 'warnings')),
        *(json.dumps({**RUN, 'ate_rmse_m': figure}) for figure in ('x', [], True, math.inf)),
        json.dumps({**RUN, 'anees': 10**400}),
        json.dumps({**RUN, 'warnings': [None]}),
        json.dumps({**RUN, 'report': 5}),
    ],
)
def test_a_line_that_is_no_run_is_left_out_and_named(tmp_path, caplog, line):
    valid = json.dumps({**RUN, 'recording': 'of another \udc80 place.mcap', 'ate_rmse_m': 0.5})
    (tmp_path / 'runs-a.jsonl').write_text(f'{valid}\n{line}\n')
    (tmp_path / 'runs-b.jsonl').write_text(line)
    os.mkfifo(tmp_path / 'runs-c.jsonl')
    lines = read_logs(tmp_path)
    assert list(lines) == ['a']
    (warning,) = [record.message for record in caplog.records]
    assert 'runs-a.jsonl: 1 lines are no runs of a batch, and left out (line 2: ' in warning
    write_index(tmp_path, lines, 'ate_rmse_m')
    page = (tmp_path / 'index.html').read_text()
    assert 'of another ? place.mcap' in page
    assert '1 runs of 1 recordings' in page


@in_this_process
def test_a_batch_goes_on_where_a_line_is_no_run(slam_observer, recordings, tmp_path):
    out = tmp_path / 'results'
    out.mkdir()
    (out / 'runs.jsonl').write_text('{"run": "0"}\n{"run": "00')
    ended = slam_observer('batch', recordings[1], '--out', out, '--workers', 1)
    assert (ended.code, ended.errors.count('\n')) == (0, 1)
    assert [line['recording'] for line in read_logs(out).values()] == [str(recordings[1])]


@in_this_process
def test_a_whole_line_without_an_end_is_kept(slam_observer, recordings, tmp_path):
    out = tmp_path / 'results'
    command = ('batch', recordings[1], '--out', out, '--workers', 1, '--json')
    slam_observer.succeed(*command)
    content = (out / 'runs.jsonl').read_bytes()
    (out / 'runs.jsonl').write_bytes(content.rstrip())
    assert slam_observer.succeed(*command).json['done_before'] == 1
    assert (out / 'runs.jsonl').read_bytes() == content


@in_this_process
def test_a_figure_that_json_has_not_stops_no_batch(slam_observer, recordings, tmp_path):
    out = tmp_path / 'results'
    grid = ('--grid', 'calibration_drift=0.01')
    slam_observer.succeed('batch', recordings[0], *grid, '--out', out, '--workers', 1)
    (line,) = lines_of(out)
    assert line['calibration']['angular_bias_z']['stated'] is None
    assert '<td>' in (out / 'index.html').read_text()


@in_this_process
def test_the_index_links_reports_and_sorts(slam_observer, beginning, tmp_path):
    out = tmp_path / 'results'
    grid = ('--grid', 'gains=constant,riccati', '--reports', '--trajectories')
    slam_observer.succeed('batch', beginning, *grid, '--out', out, '--workers', 1)
    page = out / 'index.html'
    for line in lines_of(out):
        assert (out / line['report']).stat().st_size > 100_000
        assert (out / line['trajectory']).read_text().startswith('# timestamp')
        assert line['report'] in page.read_text()
    settings = re.search(r'<h2>Settings.*?</section>', page.read_text(), re.S).group()
    assert '<tr class=best><td>riccati</td>' in settings
    opened = open_page(page)
    assert (opened.console, opened.requested) == ([], [])
    click = "<script>document.querySelector('thead button').click();</script></body>"
    page.write_text(page.read_text().replace('</body>', click))
    html = open_page(page).html
    assert html.index('<td>constant</td>') < html.index('<td>riccati</td>')
    assert 'aria-sort="ascending"' in html


def test_the_index_fits_into_a_window_whatever_is_warned_of(tmp_path):
    figures = dict.fromkeys(FIGURES, 1.2345)
    long = 'Stamps of /landmarks are 1.2 s behind the stamps of /twist, by when both came. ' * 5
    lines = {
        str(n): {
            **RUN,
            **figures,
            'run': f'{n:016x}',
            'recording': f'/data/monday/a_recording_of_robot_{n}_in_the_hall.mcap',
            'recording_sha256': str(n),
            'grid': {'range_noise': 0.1 * n},
            'warnings': [long, long],
            'report': f'reports/{n}.html',
            'trajectory': f'trajectories/{n}.tum',
        }
        for n in (1, 2)
    }
    write_index(tmp_path, lines, 'ate_rmse_m')
    page = tmp_path / 'index.html'
    script = """<script>
        const rows = [...document.querySelectorAll('tbody tr')], links = [...document.links];
        document.title = [Math.max(...rows.map((row) => row.clientHeight)), links.length,
          Math.max(...links.map((link) => link.getBoundingClientRect().right))].join();
    </script></body>"""
    page.write_text(script.join(page.read_text().rsplit('</body>', 1)))
    html = open_page(page, '', '--window-size=1440,900').html
    height, links, right = map(float, re.search('<title>([0-9.,]*)', html)[1].split(','))
    assert height < 70.0
    assert (links, right < 720.0) == (4, True)
    assert long.strip() in html


def test_no_mean_hides_how_far_from_1_the_consistency_is(tmp_path):
    lines = {
        str(n): {
            **RUN,
            'run': str(n),
            'recording_sha256': str(n),
            'anees': anees,
            'ate_rmse_m': 1.0,
        }
        for n, anees in enumerate((0.27, 2.28))
    }
    write_index(tmp_path, lines, 'ate_rmse_m')
    page = (tmp_path / 'index.html').read_text()
    assert '0.270 – 2.28' in page
    assert '1.28' not in page


@in_this_process
def test_a_run_that_used_nothing_is_seen_in_the_index(slam_observer, tmp_path):
    out, blind = tmp_path / 'results', tmp_path / 'blind.mcap'
    with RecordingWriter(blind) as writer:
        for event in events():
            if isinstance(event, ObservationEvent):
                event = replace(event, points=np.full_like(event.points, np.nan))
            writer.write_event(event)
    assert slam_observer('batch', blind, '--out', out, '--workers', 1).code == 0
    page = (out / 'index.html').read_text()
    assert '>points used<' in page
    assert '<td class="number" data-value="0">0</td>' in page
    assert 'No observation was used' in page
