"""``slam-observer simulate`` shows the paper's exponential convergence at every step."""

from __future__ import annotations

import os

import numpy as np
import pytest

from slam_observer_ros.cli.simulate import LYAPUNOV_FLOOR
from slam_observer_ros.runs.metrics import fit_decay

PAPER_SLOPE = -2.0 * (1.0 / 4.0) / np.log(10.0)


def test_by_default_log_lyapunov_falls_at_the_rate_of_the_paper(slam_observer):
    result = slam_observer.succeed('simulate', '--json').json
    assert set(result) == {'time_s', 'log10_lyapunov', 'slope_per_s', 'step_s'}
    assert result['step_s'] == 0.02
    assert result['time_s'] == pytest.approx(np.arange(1, 4001) * 0.02)
    assert len(result['log10_lyapunov']) == len(result['time_s'])
    assert result['slope_per_s'] == pytest.approx(PAPER_SLOPE, abs=0.001)
    assert result['log10_lyapunov'][-1] < -14.0


@pytest.mark.parametrize(('step_s', 'duration_s'), [(0.002, 4.0), (2.0, 80.0)])
def test_the_rate_does_not_depend_on_the_step(slam_observer, step_s, duration_s):
    result = slam_observer.succeed(
        'simulate', '--json', '--step', step_s, '--duration', duration_s
    ).json
    assert result['slope_per_s'] == pytest.approx(PAPER_SLOPE, abs=0.005)
    assert result['log10_lyapunov'][-1] < 0.5 + 0.95 * PAPER_SLOPE * duration_s


def test_many_far_landmarks(slam_observer):
    result = slam_observer.succeed(
        'simulate', '--json', '--landmarks', 100, '--distance', 50, '--duration', 15
    ).json
    assert result['slope_per_s'] == pytest.approx(PAPER_SLOPE, abs=0.005)
    assert np.diff(result['log10_lyapunov']).max() < 0.0


def test_rounding_neither_spoils_the_slope_nor_the_json(slam_observer):
    result = slam_observer.succeed('simulate', '--json', '--step', 0.2, '--duration', 300).json
    assert result['slope_per_s'] == pytest.approx(PAPER_SLOPE, abs=0.001)
    assert result['log10_lyapunov'][-1] < -24.0


@pytest.mark.parametrize(
    ('options', 'reason'),
    [
        (['--duration', '1e300'], 'are more than 10000000 steps; take a shorter one, or longer'),
        (['--step', '1e-300'], 'are more than 10000000 steps; take a shorter one, or longer'),
        (['--step', '1e-320'], 'are more than 10000000 steps; take a shorter one, or longer'),
        (['--landmarks', '1000000000'], "'landmark_count' takes a value ≥ 0, ≤ 10000, not 1000"),
    ],
)
def test_what_would_run_for_ever_is_refused(slam_observer, options, reason):
    assert reason in slam_observer.fail('simulate', *options)


def test_without_bias_there_is_nothing_to_converge(slam_observer):
    result = slam_observer.succeed('simulate', '--json', '--bias', 0, '--duration', 1).json
    assert result['slope_per_s'] is None
    assert min(result['log10_lyapunov']) >= np.log10(LYAPUNOV_FLOOR)
    assert 'none' in slam_observer.succeed('simulate', '--bias', 0, '--duration', 1).output


def test_gains_are_the_papers_unless_others_are_asked_for(slam_observer, tmp_path):
    faster = slam_observer.succeed(
        'simulate', '--json', '--step', 0.1, '--duration', 20, '--set', 'gain_l=2'
    ).json
    assert faster['slope_per_s'] == pytest.approx(2.0 * PAPER_SLOPE, abs=0.005)
    config = tmp_path / 'slow.yaml'
    config.write_text('/**: {ros__parameters: {gain_l: 0.5, publish_rate: 20.0}}')
    slower = slam_observer.succeed(
        'simulate', '--json', '--step', 0.1, '--duration', 40, '--config', config
    ).json
    assert slower['slope_per_s'] == pytest.approx(0.5 * PAPER_SLOPE, abs=0.005)


def test_one_seed_one_run(slam_observer):
    first, again, other = (
        slam_observer.succeed('simulate', '--json', '--duration', 1, '--seed', seed).output
        for seed in (1, 1, 2)
    )
    assert first == again != other


def test_recording_converges_as_the_simulation_did(slam_observer, tmp_path):
    recording = tmp_path / 'run.mcap'
    slam_observer.succeed('simulate', '--step', 0.05, '--duration', 40, '--output', recording)
    report = slam_observer.succeed('replay', recording, '--gains', 'constant', '--json').json
    assert report['events'] == 2 * 801
    assert report['landmarks'] == 4
    assert report['duration_s'] == pytest.approx(40.0)
    assert report['landmark_rmse_m'] < 1e-3
    assert [path.name for path in tmp_path.iterdir()] == ['run.mcap']


@pytest.fixture
def short():
    """The words of a short simulation."""
    return 'simulate', '--step', 0.1, '--duration', 2


def test_the_summary_names_the_slope_and_figures_show_it(slam_observer, tmp_path):
    figures = tmp_path / 'figures'
    ended = slam_observer.succeed('simulate', '--step', 0.1, '--duration', 20, '--plot', figures)
    assert '-0.217' in ended.output
    assert {path.name for path in figures.iterdir()} == {'lyapunov.png', 'configuration.png'}
    for path in figures.iterdir():
        assert path.read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize('kind', ['svg', 'pdf'])
def test_figures_are_of_the_kind_that_is_asked_for(slam_observer, short, tmp_path, kind):
    slam_observer.succeed(*short, '--plot', tmp_path / 'a', '--plot-format', kind)
    names = {path.name for path in (tmp_path / 'a').iterdir()}
    assert names == {f'lyapunov.{kind}', f'configuration.{kind}'}


def test_figures_replace_others_by_force_alone_and_leave_other_files(
    slam_observer, short, tmp_path
):
    notes, mine = tmp_path / 'notes.txt', tmp_path / 'lyapunov.png'
    for path in (notes, mine):
        path.write_text('mine')
    assert '--force' in slam_observer.fail(*short, '--plot', tmp_path)
    assert mine.read_text() == 'mine'
    slam_observer.succeed(*short, '--plot', tmp_path, '--force')
    assert mine.read_bytes().startswith(b'\x89PNG')
    assert notes.read_text() == 'mine'
    assert not list(tmp_path.glob('.*'))


def test_figures_go_where_a_link_leads(slam_observer, short, tmp_path):
    figures, elsewhere = tmp_path / 'figures', tmp_path / 'elsewhere.png'
    figures.mkdir()
    elsewhere.write_text('older')
    (figures / 'lyapunov.png').symlink_to(elsewhere)
    slam_observer.succeed(*short, '--force', '--plot', figures)
    assert (figures / 'lyapunov.png').is_symlink()
    assert elsewhere.read_bytes().startswith(b'\x89PNG')


def test_what_is_no_file_is_replaced_by_no_figure(slam_observer, short, tmp_path):
    pipe = tmp_path / 'lyapunov.png'
    os.mkfifo(pipe)
    error = slam_observer.fail(*short, '--force', '--plot', tmp_path)
    assert f'{pipe} is there, and no regular file' in error
    assert pipe.is_fifo()


def test_figures_that_can_not_be_written_are_named_as_asked_for(slam_observer, short):
    errors = slam_observer(*short, '--plot', '/proc/figures').errors
    assert "can't write figures to /proc/figures: " in errors
    assert 'unfinished' not in errors


def test_where_no_figure_may_be_written_is_reported_before_the_work(
    slam_observer, short, tmp_path, monkeypatch
):
    monkeypatch.setattr(os, 'access', lambda *_: False)  # root may write anywhere
    ended = slam_observer(*short, '--plot', tmp_path / 'new')
    assert (ended.code, ended.output) == (2, '')
    assert f'nothing may be written to {tmp_path}' in ended.errors


class TestSlope:
    TIMES = np.arange(0.0, 100.0)

    def test_only_what_is_above_rounding_counts(self):
        level = np.maximum(10.0 ** (-0.5 * self.TIMES), 1e-20)
        decay = fit_decay(self.TIMES, level, 1e-19)
        assert decay is not None
        assert decay.slope_per_s == pytest.approx(-0.5)

    def test_transient_does_not_count(self):
        level = 10.0 ** (-0.5 * self.TIMES)
        level[:40] *= 1e9
        decay = fit_decay(self.TIMES, level, 0.0)
        assert decay is not None
        assert decay.slope_per_s == pytest.approx(-0.5)

    def test_nothing_to_fit(self):
        assert fit_decay(self.TIMES[:0], self.TIMES[:0], 0.0) is None
        assert fit_decay(self.TIMES, np.zeros(100), 0.0) is None
