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

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import Trajectory
from slam_observer_ros.runs import figures
from slam_observer_ros.runs.figures import (
    BLACK,
    BLUE,
    GREEN,
    PALE_BLUE,
    RED,
)
from slam_observer_ros.runs.metrics import (
    Decay,
    fit_decay,
)

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
    path = figures.plot_lyapunov(tmp_path / 'lyapunov.png', SECONDS, values, Decay(-0.2, 0.0))
    assert {rgb(PALE_BLUE), rgb(BLACK)} <= colours(path)


def test_the_line_that_is_fitted_lies_on_the_lyapunov_function(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(figures, 'save', lambda figure, _path: saved.append(figure))
    values = 3.0 - 0.2 * SECONDS
    decay = fit_decay(SECONDS, 10.0**values, 0.0)
    figures.plot_lyapunov(tmp_path / 'a.png', SECONDS, values, decay)
    level, line = (np.asarray(drawn.get_ydata()) for drawn in saved[0].axes[0].lines)
    assert line == pytest.approx(level[: len(line)])
    assert len(line) > 190


def test_lyapunov_function_that_is_zero_throughout(tmp_path: Path) -> None:
    path = figures.plot_lyapunov(
        tmp_path / 'zero.png', SECONDS, np.full(200, -np.inf), Decay(-0.2, 0.0)
    )
    assert path.stat().st_size > 0


def test_configuration(tmp_path: Path, estimate: Trajectory, truth: Trajectory) -> None:
    tracks = LANDMARKS + np.exp(-0.3 * SECONDS)[:, None, None]
    tracks[:20, 1] = np.nan
    path = figures.plot_configuration(tmp_path / 'paths.png', estimate, truth, tracks, LANDMARKS)
    assert {rgb(BLUE), rgb(RED), rgb(GREEN)} <= colours(path)


@pytest.mark.parametrize('height_m', [0.0, 1.0, 3.0], ids=['flat', 'low', 'space'])
def test_legend_of_a_configuration_covers_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, height_m: float
) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(figures, 'save', lambda figure, _path: saved.append(figure))
    poses = se3.exp(SECONDS[:, None] * np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0]))
    poses[:, :3, 3] += [0.0, -5.0, min(height_m, 2.0)]
    circle = Trajectory((SECONDS * 1e9).astype(np.int64), poses)
    points = LANDMARKS + np.array([0.0, 0.0, height_m]) * np.array([[1.0], [-1.0], [1.0], [-1.0]])
    tracks = np.tile(points, (200, 1, 1))
    figures.plot_configuration(tmp_path / 'a.png', circle, circle, tracks, points)
    (figure,) = saved
    figure.draw_without_rendering()
    (legend,) = figure.legends
    (axes,) = figure.axes
    drawn = axes.get_tightbbox()
    assert drawn is not None
    assert not legend.get_window_extent().overlaps(drawn)
    assert 0.0 <= drawn.x0 < drawn.x1 <= figure.bbox.width, 'all labels are whole'
    names = [text.get_text() for text in legend.get_texts()]
    assert {'start', 'end', 'landmark estimates on their way'} <= set(names)
    # As the picture in the first run's page: the scene is not lost in an empty figure.
    assert drawn.height > 0.6 * figure.bbox.height


@pytest.mark.parametrize('suffix', ['png', 'svg', 'pdf'])
def test_a_figure_is_of_the_kind_of_its_suffix_and_the_same_each_time(
    tmp_path: Path, suffix: str
) -> None:
    start = {'png': b'\x89PNG', 'svg': b'<?xml', 'pdf': b'%PDF'}[suffix]
    path = tmp_path / f'lyapunov.{suffix}'
    first, second = (figures.plot_lyapunov(path, SECONDS, -SECONDS).read_bytes() for _ in range(2))
    assert first.startswith(start)
    assert first == second


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match='absent'):
        figures.plot_lyapunov(tmp_path / 'absent' / 'a.png', SECONDS, -SECONDS)


def test_matplotlibs_settings_and_backend_stay_as_they_were(tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    figures.plot_lyapunov(tmp_path / 'lyapunov.png', SECONDS, -SECONDS)
    assert dict(mpl.rcParams) == before
    module = 'slam_observer_ros.runs.figures'
    program = f"import sys, {module}; print('matplotlib.pyplot' in sys.modules)"
    result = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stdout.strip() == 'False'
