"""Figures are written, show something, and change no setting of matplotlib's."""

from __future__ import annotations

from itertools import combinations, pairwise
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
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID, FloatArray
from slam_observer_ros.estimates import Innovations
from slam_observer_ros.evaluation import map_plot, replay_plots, simulation_plots
from slam_observer_ros.evaluation.consistency import nees_over_time
from slam_observer_ros.evaluation.drawing import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PALE_BLUE,
    plain_decades,
    PURPLE,
    RED,
)
from slam_observer_ros.evaluation.metrics import (
    ConfigurationError,
    Decay,
    fit_decay,
    trajectory_errors,
)
from slam_observer_ros.evaluation.trajectory import LandmarkTruth, Trajectory
from slam_observer_ros.geometry import se3
from slam_observer_ros.settings.estimator_settings import Settings

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
        tmp_path / 'lyapunov.png', SECONDS, values, Decay(-0.2, 0.0)
    )
    assert {rgb(PALE_BLUE), rgb(BLACK)} <= colours(path)


def test_the_line_that_is_fitted_lies_on_the_lyapunov_function(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(simulation_plots, 'save', lambda figure, _path: saved.append(figure))
    values = 3.0 - 0.2 * SECONDS
    decay = fit_decay(SECONDS, 10.0**values, 0.0)
    simulation_plots.plot_lyapunov(tmp_path / 'a.png', SECONDS, values, decay)
    level, line = (np.asarray(drawn.get_ydata()) for drawn in saved[0].axes[0].lines)
    assert line == pytest.approx(level[: len(line)])
    assert len(line) > 190


def test_lyapunov_function_that_is_zero_throughout(tmp_path: Path) -> None:
    path = simulation_plots.plot_lyapunov(
        tmp_path / 'zero.png', SECONDS, np.full(200, -np.inf), Decay(-0.2, 0.0)
    )
    assert path.stat().st_size > 0


def test_configuration(tmp_path: Path, estimate: Trajectory, truth: Trajectory) -> None:
    tracks = LANDMARKS + np.exp(-0.3 * SECONDS)[:, None, None]
    tracks[:20, 1] = np.nan
    path = simulation_plots.plot_configuration(
        tmp_path / 'paths.png', estimate, truth, tracks, LANDMARKS
    )
    assert {rgb(BLUE), rgb(RED), rgb(GREEN)} <= colours(path)


@pytest.mark.parametrize('height_m', [0.0, 1.0, 3.0], ids=['flat', 'low', 'space'])
def test_legend_of_a_configuration_covers_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, height_m: float
) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(simulation_plots, 'save', lambda figure, _path: saved.append(figure))
    poses = se3.exp(SECONDS[:, None] * np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0]))
    poses[:, :3, 3] += [0.0, -5.0, min(height_m, 2.0)]
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
    assert 0.0 <= drawn.x0 < drawn.x1 <= figure.bbox.width, 'all labels are whole'
    names = [text.get_text() for text in legend.get_texts()]
    assert {'start', 'end', 'landmark estimates on their way'} <= set(names)
    # As the picture in the first run's page: the scene is not lost in an empty figure.
    assert drawn.height > 0.6 * figure.bbox.height


@pytest.mark.parametrize(
    ('limits', 'expected'),
    [((0.15, 7.0), ['0.2', '0.5', '1', '2', '5']), ((0.05, 2000.0), ['0.1', '1', '10', '100'])],
)
def test_a_logarithmic_axis_has_plain_numbers(
    limits: tuple[float, float], expected: list[str]
) -> None:
    axes = Figure(figsize=(6.0, 3.0)).add_subplot()
    axes.set(yscale='log', ylim=limits)
    plain_decades(axes)
    axes.figure.draw_without_rendering()
    texts = [text.get_text() for text in axes.get_yticklabels(which='both')]
    assert set(expected) <= set(texts)
    assert not [text for text in texts if '10^' in text]


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


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures of a replay, which are kept here and not written."""
    figures: list[Figure] = []
    for module in (map_plot, replay_plots):
        monkeypatch.setattr(module, 'save', lambda figure, _path: figures.append(figure))
    return figures


def corridor() -> tuple[Trajectory, FloatArray]:
    """A path along 100 m, and 60 landmarks no more than 2 m beside it."""
    generator = np.random.default_rng(1)
    spread = generator.uniform([0.0, -2.0, 0.0], [100.0, 2.0, 0.0], (60, 3))
    along = SECONDS[:, None] * np.array([0.0, 0.0, 0.0, 100.0 / 30.0, 0.0, 0.0])
    return Trajectory((SECONDS * 1e9).astype(np.int64), se3.exp(along)), spread


@pytest.mark.parametrize('height_m', [0.0, 40.0], ids=['flat', 'space'])
def test_labels_of_a_map_hit_nothing(tmp_path: Path, saved: list[Figure], height_m: float) -> None:
    path, points = corridor()
    poses = path.poses.copy()
    poses[:, 2, 3] = np.linspace(0.0, height_m, len(poses))
    estimate = Trajectory(path.stamps_ns, poses)
    known = LandmarkTruth(np.arange(60) + 100, points + [1.0, 0.3, 0.0])
    map_plot.plot_map(tmp_path / 'a.png', estimate, known.ids, points, estimate, known)
    (figure,) = saved
    figure.draw_without_rendering()
    axes = figure.axes[0]
    boxes = [label.get_window_extent() for label in axes.texts]
    assert len(boxes) > 15
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    assert all(
        axes.bbox.containsx(x) and axes.bbox.containsy(y) for a in boxes for x, y in a.corners()
    )
    markers = axes.transData.transform(np.concatenate([points, known.world_points])[:, :2])
    radius = 4.5 * figure.dpi / 72.0
    for box in boxes:
        nearest = np.clip(markers, box.min, box.max)
        assert np.linalg.norm(markers - nearest, axis=1).min() > radius


def test_labels_of_a_map_stand_beside_their_landmarks(
    tmp_path: Path, saved: list[Figure], estimate: Trajectory
) -> None:
    map_plot.plot_map(tmp_path / 'a.png', estimate, IDS, LANDMARKS)
    (figure,) = saved
    figure.draw_without_rendering()
    labels = {int(label.get_text()): label for label in figure.axes[0].texts}
    assert sorted(labels) == IDS.tolist()
    for number, point in zip(IDS.tolist(), LANDMARKS, strict=True):
        box = labels[number].get_window_extent()
        place = figure.axes[0].transData.transform(point[:2])
        apart = np.linalg.norm(place - np.clip(place, box.min, box.max))
        assert apart < 10.0 * figure.dpi / 72.0


def test_a_line_leads_from_each_landmark_to_its_truth(
    tmp_path: Path, saved: list[Figure], estimate: Trajectory
) -> None:
    ids, points = np.array([7, 3, 5]), LANDMARKS[:3] + 0.2
    known = LandmarkTruth(np.array([5, 6, 7]), LANDMARKS[[2, 3, 0]])
    map_plot.plot_map(tmp_path / 'a.png', estimate, ids, points, estimate, known)
    for axes in saved[0].axes:
        lines = np.concatenate([np.empty((0, 2)), *(line.get_xydata() for line in axes.lines)])
        both = [np.r_[a, b] for a, b in pairwise(lines)]
        columns = ['xyz'.index(label[0]) for label in (axes.get_xlabel(), axes.get_ylabel())]
        for row, true_row, is_joined in [(0, 0, True), (2, 2, True), (1, 3, False)]:
            wanted = np.r_[points[row, columns], LANDMARKS[true_row, columns]]
            assert any(np.allclose(pair, wanted) for pair in both) is is_joined


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_legend_of_a_map_names_what_there_is(
    tmp_path: Path, saved: list[Figure], estimate: Trajectory, truth: Trajectory
) -> None:
    nothing = np.empty(0, dtype=np.int64), np.empty((0, 3))
    map_plot.plot_map(tmp_path / 'a.png', estimate, *nothing, truth, LandmarkTruth(*nothing))
    map_plot.plot_map(tmp_path / 'a.png', estimate, IDS, LANDMARKS)
    path = ['estimated path', 'start', 'end']
    assert legend_of(saved[0]) == ['true path', *path]
    assert legend_of(saved[1]) == [*path, 'estimated landmarks']


@pytest.mark.parametrize('is_smoothed', [False, True])
def test_a_title_says_what_is_smoothed(
    tmp_path: Path,
    saved: list[Figure],
    estimate: Trajectory,
    truth: Trajectory,
    is_smoothed: bool,
) -> None:
    errors = trajectory_errors(estimate, truth)
    plot: Any = map_plot.plot_map
    plot(tmp_path / 'a.png', estimate, IDS, LANDMARKS, is_smoothed=is_smoothed)
    plot(tmp_path / 'a.png', estimate, IDS, LANDMARKS, truth, is_smoothed=is_smoothed)
    replay_plots.plot_errors(tmp_path / 'a.png', errors, is_smoothed=is_smoothed)
    titles = [figure.texts[0].get_text() for figure in saved[:2]]
    titles.append(saved[2].axes[0].get_title('left'))
    assert [('smoothed' in title.lower()) for title in titles] == [is_smoothed] * 3
    assert [('after rigid alignment' in title) for title in titles] == [False, True, True]


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
    assert not {rgb(GREEN), rgb(PURPLE)} & colours(path)
    configuration = ConfigurationError([0, 10**9], [0.1, 0.2])
    nees = nees_over_time(errors, np.tile(0.01 * np.eye(6), (200, 1, 1)), is_anchored=True)
    path = replay_plots.plot_errors(tmp_path / 'all.png', errors, nees, configuration)
    assert {rgb(RED), rgb(GREEN), rgb(PURPLE)} <= colours(path)


@pytest.mark.parametrize('is_anchored', [False, True])
def test_a_panel_says_which_errors_are_normalised(
    tmp_path: Path,
    saved: list[Figure],
    estimate: Trajectory,
    truth: Trajectory,
    is_anchored: bool,
) -> None:
    errors = trajectory_errors(estimate, truth)
    nees = nees_over_time(errors, np.tile(np.eye(6), (200, 1, 1)), is_anchored)
    replay_plots.plot_errors(tmp_path / 'a.png', errors, nees, is_anchored=is_anchored)
    title = saved[0].axes[-1].get_title('left')
    assert ('from the first pose on' in title) is is_anchored
    assert ('after rigid alignment' in title) is not is_anchored


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


def innovations(number: int, **changed: Any) -> Innovations:
    """Residuals every 0.1 s, of one to three standard deviations."""
    values = np.linspace(1.0, 3.0, number)
    counts, none = np.arange(number, dtype=np.int64), np.empty(0)
    given: dict[str, Any] = {
        'stamps_ns': counts * 10**8, 'ids': counts, 'distances': values,
        'residuals': 0.1 * values[:, None] * np.array([1.0, 0.0, 0.0]),
        'weights': np.ones(number), 'moved': np.zeros(number, dtype=np.bool_),
        'update_stamps_ns': none.astype(np.int64), 'nis': none,
        'degrees_of_freedom': none.astype(np.int64), 'lyapunov': none,
    }  # fmt: skip
    return Innovations(**given | changed)


@pytest.mark.parametrize('dropped', [{}, {'not_finite': 3, 'duplicate': 40}])
def test_residuals(tmp_path: Path, dropped: dict[str, int]) -> None:
    drawn = tmp_path / 'residuals.png'
    replay_plots.plot_residuals(drawn, innovations(500), Settings(), dropped, 1_000)
    assert rgb(ORANGE) not in colours(drawn)
    assert (rgb(BLUE) in colours(drawn)) is bool(dropped)
    weights = np.where(np.arange(500) % 50, 1.0, 0.5)
    replay_plots.plot_residuals(
        drawn, innovations(500, weights=weights), Settings(), dropped, 1_000
    )
    assert rgb(ORANGE) in colours(drawn)


@pytest.mark.parametrize('is_known', [False, True])
def test_residuals_are_in_standard_deviations_where_the_gains_know_them(
    tmp_path: Path, saved: list[Figure], is_known: bool
) -> None:
    changed = {} if is_known else {'distances': np.zeros(500)}
    replay_plots.plot_residuals(
        tmp_path / 'a.png', innovations(500, **changed), Settings(), {}, 500
    )
    (axes,) = saved[0].axes
    legend = axes.get_legend()
    assert legend is not None
    names = [text.get_text() for text in legend.get_texts()]
    assert axes.get_ylabel() == ('residual [σ]' if is_known else 'residual [m]')
    assert ('gate' in names) is is_known
    assert names[-1] == ('median 2.00 σ (0.200 m)' if is_known else 'median 0.200 m')


@pytest.mark.parametrize('are_there', [False, True])
def test_bars_of_dropped_events_are_thin(
    tmp_path: Path, saved: list[Figure], are_there: bool
) -> None:
    some = innovations(500 if are_there else 0)
    reasons = {f'reason_{i}': 10 + i for i in range(9)}
    for dropped in ({'no_transform': 31}, reasons):
        replay_plots.plot_residuals(tmp_path / 'a.png', some, Settings(), dropped, 900)
        figure = saved[-1]
        figure.draw_without_rendering()
        assert len(figure.axes) == 1 + are_there
        bars = figure.axes[-1].patches
        assert len(bars) == len(dropped)
        heights_in = [bar.get_window_extent().height / figure.dpi for bar in bars]
        assert heights_in == pytest.approx([0.15] * len(bars), abs=0.05)


def test_legend_of_residuals_is_one_row_below_the_title(
    tmp_path: Path, saved: list[Figure]
) -> None:
    weights = np.where(np.arange(500) % 10, 1.0, np.where(np.arange(500) % 20, 0.5, 0.0))
    some = innovations(500, weights=weights)
    replay_plots.plot_residuals(tmp_path / 'a.png', some, Settings(), {}, 123_456)
    (figure,) = saved
    figure.draw_without_rendering()
    (axes,) = figure.axes
    legend = axes.get_legend()
    assert legend is not None
    texts = legend.get_texts()
    assert [text.get_text() for text in texts[:2]] == ['25 down-weighted', '25 rejected']
    heights = {round(text.get_window_extent().y0) for text in texts}
    assert max(heights) - min(heights) <= 5
    title = next(child for child in axes.get_children() if 'none of' in str(child))
    assert not legend.get_window_extent().overlaps(title.get_window_extent())
    assert legend.get_window_extent().x1 <= figure.bbox.x1


def test_residuals_of_a_run_without_any(tmp_path: Path, saved: list[Figure]) -> None:
    replay_plots.plot_residuals(tmp_path / 'none.png', innovations(0), Settings(), {}, 0)
    (axes,) = saved[0].axes
    assert [text.get_text() for text in axes.texts] == ['no residuals']
    assert len(axes.get_xticks()) == len(axes.get_yticks()) == 0


@pytest.mark.parametrize('suffix', ['png', 'svg', 'pdf'])
def test_a_figure_is_of_the_kind_of_its_suffix_and_the_same_each_time(
    tmp_path: Path, suffix: str, estimate: Trajectory
) -> None:
    start = {'png': b'\x89PNG', 'svg': b'<?xml', 'pdf': b'%PDF'}[suffix]
    path = tmp_path / f'map.{suffix}'
    first, second = (
        map_plot.plot_map(path, estimate, IDS, LANDMARKS).read_bytes() for _ in range(2)
    )
    assert first.startswith(start)
    assert first == second


def test_ellipses_are_drawn_where_the_map_is_after_the_alignment(
    tmp_path: Path, saved: list[Figure], estimate: Trajectory
) -> None:
    quarter = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0, 0, 1, 0], [0, 0, 0, 1]])
    covariances = np.tile(np.diag([0.04, 0.01, 0.0]), (4, 1, 1))
    map_plot.plot_map(
        tmp_path / 'a.png', estimate, IDS, LANDMARKS, estimate.moved(quarter),
        covariances=covariances,
    )  # fmt: skip
    line = next(line for line in saved[0].axes[0].lines if line.get_label() == '95 % ellipses')
    first = np.asarray(line.get_xydata())[:37] - LANDMARKS[0, [1, 0]]
    # Two to one, and turned with the map.
    assert np.ptp(first, axis=0) == pytest.approx(
        2.0 * np.sqrt(5.991) * np.array([0.1, 0.2]), 1e-2
    )


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
