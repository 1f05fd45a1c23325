"""Figures are written, show something, and change no setting of matplotlib's."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.image import imread
import numpy as np
import pytest

from slam_observer_ros.errors import EvaluationError
from slam_observer_ros.evaluation import map_plot, replay_plots, simulation_plots
from slam_observer_ros.evaluation.configuration_error import ConfigurationError
from slam_observer_ros.evaluation.drawing import BLUE, GREEN, GREY, RED
from slam_observer_ros.evaluation.metrics import trajectory_errors
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.events import FIRST_AUTOMATIC_ID
from slam_observer_ros.geometry import se3
from slam_observer_ros.truth import LandmarkTruth

LANDMARKS = np.array([[4.0, 0.0, 0.0], [-4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, -4.0, 0.0]])
IDS = np.arange(4)
SECONDS = np.linspace(0.0, 30.0, 200)


@pytest.fixture(params=[0.0, 2.0], ids=['flat', 'space'])
def truth(request: pytest.FixtureRequest) -> Trajectory:
    twist = np.array([0.0, 0.0, 0.2, 1.0, 0.0, request.param / 30.0])
    return Trajectory((SECONDS * 1e9).astype(np.int64), se3.exp(SECONDS[:, None] * twist))


@pytest.fixture
def estimate(truth: Trajectory) -> Trajectory:
    bias = np.exp(-0.3 * SECONDS)[:, None] * [0.0, 0.0, 0.2, 0.5, 0.3, 0.0]
    return Trajectory(truth.stamps_ns, truth.poses @ se3.exp(bias))


def pixels_of(path: Path) -> Any:
    """Return the colours (height, width) of a picture, 0xRRGGBB."""
    return (imread(path)[..., :3] * 255.0).round().astype(np.int64) @ [1 << 16, 1 << 8, 1]


def colours(path: Path) -> set[int]:
    """Colours (0xRRGGBB) that cover a visible part of a picture."""
    values, counts = np.unique(pixels_of(path), return_counts=True)
    return set(values[counts > 20].tolist())


def rgb(colour: str) -> int:
    return int(colour.removeprefix('#'), 16)


def test_lyapunov_function(tmp_path: Path) -> None:
    values = np.append(-0.2 * SECONDS[:-1], -np.inf)
    path = simulation_plots.plot_lyapunov(
        tmp_path / 'lyapunov.png', SECONDS, values, slope_per_s=-0.2
    )
    assert {rgb(BLUE), rgb(GREY)} <= colours(path)


def test_lyapunov_function_that_is_zero_throughout(tmp_path: Path) -> None:
    path = simulation_plots.plot_lyapunov(
        tmp_path / 'zero.png', SECONDS, np.full(200, -np.inf), -0.2
    )
    assert path.stat().st_size > 0


def test_configuration(tmp_path: Path, estimate: Trajectory, truth: Trajectory) -> None:
    tracks = LANDMARKS + np.exp(-0.3 * SECONDS)[:, None, None]
    tracks[:20, 1] = np.nan
    path = simulation_plots.plot_configuration(
        tmp_path / 'paths.png', estimate, truth, tracks, LANDMARKS
    )
    assert {rgb(BLUE), rgb(RED), rgb(GREEN)} <= colours(path)


@pytest.mark.parametrize('height_m', [0.0, 3.0], ids=['flat', 'space'])
def test_legend_of_a_configuration_covers_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, height_m: float
) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(simulation_plots, 'save', lambda figure, _path: saved.append(figure))
    poses = se3.exp(SECONDS[:, None] * np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0]))
    circle = Trajectory((SECONDS * 1e9).astype(np.int64), poses)
    points = LANDMARKS + np.array([0.0, 0.0, height_m]) * np.array([[1.0], [-1.0], [1.0], [-1.0]])
    tracks = np.tile(points, (200, 1, 1))
    simulation_plots.plot_configuration(tmp_path / 'a.png', circle, circle, tracks, points)
    (figure,) = saved
    figure.draw_without_rendering()
    (legend,) = figure.legends
    (axes,) = figure.axes
    drawn = axes.get_tightbbox()
    assert drawn is not None
    assert not legend.get_window_extent().overlaps(drawn)


def test_labels_of_a_map_erase_no_marker(tmp_path: Path, estimate: Trajectory) -> None:
    crowded = np.linspace(0.0, 2.0, 30)[:, None] * np.array([1.0, 0.2, 0.0])
    numbers = np.arange(30) + 12345
    labelled = map_plot.plot_map(tmp_path / 'a.png', estimate, numbers, crowded)
    unnamed = numbers + FIRST_AUTOMATIC_ID
    bare = map_plot.plot_map(tmp_path / 'b.png', estimate, unnamed, crowded)
    green, bare_green = (int(np.sum(pixels_of(path) == rgb(GREEN))) for path in (labelled, bare))
    # Where edges of markers overlap, what is below them may change a pixel's last bit.
    assert green == pytest.approx(bare_green, rel=2e-3)
    assert np.any(pixels_of(labelled) != pixels_of(bare))


def test_map_with_truth(tmp_path: Path, estimate: Trajectory, truth: Trajectory) -> None:
    known = LandmarkTruth(IDS, LANDMARKS)
    path = map_plot.plot_map(tmp_path / 'map.png', estimate, IDS, LANDMARKS + 0.2, truth, known)
    assert {rgb(BLUE), rgb(RED), rgb(GREEN)} <= colours(path)


def test_map_without_truth(tmp_path: Path, estimate: Trajectory) -> None:
    path = map_plot.plot_map(tmp_path / 'map.png', estimate, IDS, LANDMARKS)
    assert rgb(BLUE) not in colours(path)
    assert {rgb(RED), rgb(GREEN)} <= colours(path)


def test_map_of_a_robot_that_saw_and_did_nothing(tmp_path: Path) -> None:
    standing = Trajectory(np.array([0]), np.eye(4)[None])
    empty = np.empty(0, dtype=np.int64), np.empty((0, 3))
    assert rgb(RED) in colours(map_plot.plot_map(tmp_path / 'map.png', standing, *empty))


@pytest.mark.parametrize('landmarks', [0, 4])
def test_map_without_a_path(tmp_path: Path, landmarks: int) -> None:
    nowhere = Trajectory(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)))
    ids, points = IDS[:landmarks], LANDMARKS[:landmarks]
    assert map_plot.plot_map(tmp_path / 'map.png', nowhere, ids, points).exists()


def test_errors(tmp_path: Path, estimate: Trajectory, truth: Trajectory) -> None:
    errors = trajectory_errors(estimate, truth)
    path = replay_plots.plot_errors(tmp_path / 'errors.png', errors)
    assert rgb(RED) in colours(path)
    assert rgb(GREEN) not in colours(path)
    configuration = ConfigurationError([0, 10**9], [0.1, 0.2])
    covariances = np.tile(0.01 * np.eye(6), (200, 1, 1))
    path = replay_plots.plot_errors(tmp_path / 'bands.png', errors, covariances, configuration)
    assert {rgb(RED), rgb(GREEN)} <= colours(path)


def test_errors_are_not_joined_across_a_time_without_any(
    tmp_path: Path, estimate: Trajectory, truth: Trajectory
) -> None:
    whole = replay_plots.plot_errors(tmp_path / 'whole.png', trajectory_errors(estimate, truth))
    ends = np.r_[0:20, 180:200]
    seen = Trajectory(estimate.stamps_ns[ends], estimate.poses[ends])
    gap = replay_plots.plot_errors(tmp_path / 'gap.png', trajectory_errors(seen, truth))

    def drawn_in_the_middle(path: Path) -> bool:
        pixels = pixels_of(path)
        width = pixels.shape[1]
        return bool(np.any(pixels[:, width // 2 - 20 : width // 2 + 20] == rgb(RED)))

    assert drawn_in_the_middle(whole)
    assert not drawn_in_the_middle(gap)


@pytest.mark.parametrize('dropped', [{}, {'not_finite': 3, 'duplicate': 40}])
def test_residuals(tmp_path: Path, dropped: dict[str, int]) -> None:
    residuals = np.random.default_rng(0).normal(size=(500, 3))
    stamps_ns = np.arange(500) * 10**8
    rejected = np.zeros(500, dtype=bool)
    drawn = tmp_path / 'residuals.png'
    replay_plots.plot_residuals(drawn, stamps_ns, residuals, rejected, dropped, 1_000)
    assert rgb(RED) not in colours(drawn)
    assert (rgb(BLUE) in colours(drawn)) is bool(dropped)
    rejected[::50] = True
    replay_plots.plot_residuals(drawn, stamps_ns, residuals, rejected, dropped, 1_000)
    assert rgb(RED) in colours(drawn)


def test_residuals_of_a_run_without_any(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(replay_plots, 'save', lambda figure, _path: saved.append(figure))
    empty = np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty(0, dtype=bool)
    replay_plots.plot_residuals(tmp_path / 'none.png', *empty, {}, 0)
    (axes,) = saved[0].axes
    assert [text.get_text() for text in axes.texts] == ['no residuals']
    assert len(axes.get_xticks()) == len(axes.get_yticks()) == 0


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match='absent'):
        simulation_plots.plot_lyapunov(tmp_path / 'absent' / 'a.png', SECONDS, -SECONDS)


def test_matplotlibs_settings_and_backend_stay_as_they_were(tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    simulation_plots.plot_lyapunov(tmp_path / 'lyapunov.png', SECONDS, -SECONDS)
    assert dict(mpl.rcParams) == before
    module = 'slam_observer_ros.evaluation.replay_plots'
    program = f"import sys, {module}; print('matplotlib.pyplot' in sys.modules)"
    result = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stdout.strip() == 'False'
