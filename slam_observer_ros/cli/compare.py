"""``slam-observer compare``: gains, settings and other tools on one recording, side by side.

What is compared is also the drift: how far an estimate goes astray over a length of the true path.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import logging
from pathlib import Path
import re

import numpy as np

from slam_observer_ros.cli.console import print_columns, print_json
from slam_observer_ros.cli.options import add_settings_options, named, named_path, read_given
from slam_observer_ros.cli.outputs import add_force_option, check_inputs_are_kept, check_outputs
from slam_observer_ros.cli.replay import as_json, NEARLY_ALL
from slam_observer_ros.cli.replay_request import (
    add_run_options,
    read_request,
    Records,
    ReplayRequest,
    select_inputs,
)
from slam_observer_ros.cli.replay_run import replayed
from slam_observer_ros.common.errors import EvaluationError, UsageError
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimator.placement import DESIGNS
from slam_observer_ros.evaluation.drawing import SUFFIXES
from slam_observer_ros.evaluation.map_plot import plot_overlay
from slam_observer_ros.evaluation.metrics import trajectory_errors, TrajectoryErrors
from slam_observer_ros.evaluation.trajectory import MAX_GAP_NS, read_tum, Trajectory
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.recording.opening import files_of
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.runs.accuracy import ACCURACY_ROWS, FIGURES, number_text, TRAJECTORY_ROWS
from slam_observer_ros.settings.input_settings import InputSettings

LENGTHS_M = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1)
"""Lengths of path over which drift is measured: the first that fits twice into the true path."""

LENGTH_TOLERANCE = 0.1
"""By how much a piece of path may be longer or shorter than asked for, as a share."""


GAP = 3.0
"""Usual periods of a trajectory after which there is a gap in it."""


@dataclass(frozen=True, slots=True, eq=False)
class RelativeErrors:
    """Relative pose errors (RPE) over k pieces of the true path, each ``length_m`` long.

    Of the motions between first and last pose of a piece, (Q⁻¹Q')⁻¹ P⁻¹P' with true poses Q and
    estimates P; ``translations_m`` (k,) and ``rotations_rad`` (k,) are how large it is. Pieces
    begin at every pose, as those of ``evo_rpe --all_pairs --pairs_from_reference``.
    """

    length_m: float
    translations_m: FloatArray
    rotations_rad: FloatArray

    @property
    def drift(self) -> float:
        """Mean error of the position as a share of the path."""
        return float(self.translations_m.mean()) / self.length_m

    @property
    def turn_rad_per_m(self) -> float:
        """Mean error of the attitude by the path, rad/m."""
        return float(self.rotations_rad.mean()) / self.length_m


def path_lengths(trajectory: Trajectory) -> FloatArray:
    """Return how long (k,) the path is until each pose, metres."""
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    return np.concatenate([np.zeros(min(1, len(trajectory))), np.cumsum(steps)])


def fitting_length(truth: Trajectory) -> float | None:
    """Return the length of path over which drift is to be measured; None if there is no motion."""
    whole_m = path_lengths(truth)[-1] if len(truth) else 0.0
    return next((length_m for length_m in LENGTHS_M if 2.0 * length_m <= whole_m), None)


def trajectory_figures(errors: TrajectoryErrors, truth: Trajectory) -> dict[str, int | float]:
    """Return by what a trajectory is compared with others, beside its ATE; ``truth`` is whole."""
    distances_m = errors.distances_m
    figures: dict[str, int | float] = {
        'poses_compared': len(errors.truth),
        'time_compared': _seconds_of(errors.truth) / max(_seconds_of(truth), 1e-9),
        'ate_max_m': float(distances_m.max()),
        'ate_median_m': float(np.median(distances_m)),
        'ate_std_m': float(distances_m.std()),
        'path_length_m': float(path_lengths(errors.estimate)[-1]),
        'true_path_length_m': float(path_lengths(errors.truth)[-1]),
    }
    length_m = fitting_length(truth)
    relative = None if length_m is None else relative_errors(errors, length_m)
    if relative is not None:
        figures |= {
            'drift': relative.drift,
            'drift_rad_per_m': relative.turn_rad_per_m,
            'drift_length_m': relative.length_m,
        }
    return figures


def _seconds_of(trajectory: Trajectory) -> float:
    """Return the time that poses cover, without the gaps between them, seconds."""
    steps_s = to_s(np.diff(trajectory.stamps_ns))
    if not len(steps_s):
        return 0.0
    longest_s = max(to_s(MAX_GAP_NS), GAP * float(np.median(steps_s)))
    return float(steps_s[steps_s <= longest_s].sum())


def relative_errors(errors: TrajectoryErrors, length_m: float) -> RelativeErrors | None:
    """Return those of a trajectory over a length of path; None if no piece is so long."""
    lengths_m = path_lengths(errors.truth)
    first = np.arange(len(lengths_m))
    last = _nearest(lengths_m, lengths_m + length_m)
    off_m = np.abs(lengths_m[last] - lengths_m - length_m)
    is_piece = (last > first) & (off_m <= LENGTH_TOLERANCE * length_m)
    if not is_piece.any():
        return None
    first, last = first[is_piece], last[is_piece]
    true_poses, poses = errors.truth.poses, errors.estimate.poses
    true_motions = se3.inverse(true_poses[first]) @ true_poses[last]
    motions = se3.inverse(poses[first]) @ poses[last]
    E = se3.inverse(true_motions) @ motions
    return RelativeErrors(
        length_m,
        np.linalg.norm(E[:, :3, 3], axis=1),
        np.linalg.norm(so3.log(E[:, :3, :3]), axis=1),
    )


def _nearest(increasing: FloatArray, wanted: FloatArray) -> IntArray:
    """Return the first row of what is nearest to each of ``wanted``."""
    after = np.minimum(np.searchsorted(increasing, wanted), len(increasing) - 1)
    before = np.searchsorted(increasing, increasing[np.maximum(after - 1, 0)])
    is_before = wanted - increasing[before] <= increasing[after] - wanted
    rows: IntArray = np.where(is_before, before, after)
    return rows


_ROWS = list(TRAJECTORY_ROWS)
NAMES = (*_ROWS[:2], *FIGURES[:2], *_ROWS[2:], 'drift_length_m', *FIGURES[2:])
"""Figures of each, in the order of the table."""

TUM_SUFFIXES = ('.tum', '.txt')

_NAMES = {'nis': 'NIS', 'seconds': 'CPU time [s]'}

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A trajectory or run that is compared with others."""

    trajectory: Trajectory
    figures: Mapping[str, object]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Compare gain designs, parameter files and the trajectories of other tools on one '
        'recording: one table, and one picture.'
    )
    parser.add_argument('recording', type=named_path, metavar='RECORDING')
    parser.add_argument(
        'what',
        nargs='+',
        type=named,
        metavar='WHAT',
        help=f'{", ".join(DESIGNS)}: gains, with the settings given; a parameter file: that in '
        'place of --config; a .tum or .txt file: a trajectory of any tool, or of batch '
        '--trajectories',
    )
    outputs = parser.add_argument_group('outputs')
    outputs.add_argument(
        '--plot',
        type=named_path,
        metavar='FILE',
        help=f'picture, of a suffix {", ".join(SUFFIXES)}',
    )
    outputs.add_argument('--json', action='store_true', help='print one JSON object')
    add_force_option(parser)
    add_run_options(parser)
    add_settings_options(parser, InputSettings)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Run or read each, and put all side by side."""
    if args.plot is not None and args.plot.suffix.removeprefix('.') not in SUFFIXES:
        raise UsageError(f'--plot {args.plot}: its suffix is to be one of {", ".join(SUFFIXES)}')
    compared_files = [Path(what) for what in args.what]
    read = {f'the recording {args.recording}': files_of(args.recording)}
    check_inputs_are_kept({'--plot': args.plot}, read | {'what is compared': compared_files})
    check_outputs([args.plot], args.force)
    if len(set(args.what)) < len(args.what):
        raise UsageError('each is compared once')
    request = read_request(args, read_given(args), args.recording)
    requests = {what: _request(args, request, what) for what in args.what}
    truth = _truth(request)
    compared = {what: _compared(what, requests[what], truth) for what in args.what}
    if args.plot is not None:
        plot_overlay(args.plot, *_in_one_frame(compared, truth))
    _warn_of_parts(compared)
    _print(args, compared)


def _request(args: argparse.Namespace, request: ReplayRequest, what: str) -> ReplayRequest | None:
    """Return the run that a compared name asks for; None for a trajectory."""
    if what in DESIGNS:
        request = request.with_values({'gains': what})
    elif Path(what).suffix in TUM_SUFFIXES:
        return None
    else:
        request = read_request(args, read_given(args, config=what), args.recording)
    return replace(request, records=Records(poses=True))


def _truth(request: ReplayRequest) -> Trajectory | None:
    with Recording(request.recording) as recording:
        _, _, truth = select_inputs(request, recording)
    return Trajectory(truth.stamps_ns, truth.poses) if len(truth.stamps_ns) else None


def _compared(what: str, request: ReplayRequest | None, truth: Trajectory | None) -> Compared:
    if request is not None:
        outcome, _ = replayed(request)
        errors = outcome.accuracy.pose_errors
        figures = as_json(outcome) | (
            {} if errors is None or truth is None else trajectory_figures(errors, truth)
        )
        return Compared(outcome.trajectory, figures)
    trajectory = read_tum(Path(what))
    if truth is None:
        return Compared(trajectory, {})
    try:
        errors = trajectory_errors(trajectory, truth)
    except EvaluationError as error:
        raise EvaluationError(f'{what}: {error}') from error
    figures = {'ate_rmse_m': errors.ate_rmse_m, 'heading_rmse_rad': errors.heading_rmse_rad}
    return Compared(trajectory, figures | trajectory_figures(errors, truth))


def _in_one_frame(
    compared: Mapping[str, Compared], truth: Trajectory | None
) -> tuple[dict[str, Trajectory], Trajectory | None]:
    """Return all trajectories in the frame of the truth, or as they are; and the truth."""
    trajectories = {what: one.trajectory for what, one in compared.items()}
    if truth is None:
        return trajectories, None
    aligned = {
        what: trajectory.moved(trajectory_errors(trajectory, truth).alignment)
        for what, trajectory in trajectories.items()
    }
    return aligned, truth.during(next(iter(aligned.values())))


def _warn_of_parts(compared: Mapping[str, Compared]) -> None:
    """Say whose figures are of a part of the time only: it may have been the easy one."""
    shares = {
        what: share
        for what, one in compared.items()
        if isinstance(share := one.figures.get('time_compared'), float)
    }
    most = max(shares.values(), default=0.0)
    for what, share in shares.items():
        if share < NEARLY_ALL * most:
            logger.warning(
                '%s covers %.1f %% of the time of the truth, another one %.1f %%: its figures are '
                'of that part only.',
                what,
                100.0 * share,
                100.0 * most,
            )


def _print(args: argparse.Namespace, compared: Mapping[str, Compared]) -> None:
    figures = {what: one.figures for what, one in compared.items()}
    if args.json:
        rows = {what: {name: row.get(name) for name in NAMES} for what, row in figures.items()}
        print_json({'recording': str(args.recording), 'compared': rows})
        return
    known = [name for name in NAMES if any(row.get(name) is not None for row in figures.values())]
    length_m = next((row['drift_length_m'] for row in figures.values() if 'drift' in row), None)
    lines = [
        [_label(name, length_m), *(_text(name, row.get(name)) for row in figures.values())]
        for name in known
        if name != 'drift_length_m'
    ]
    print_columns(str(args.recording), ['', *_headings(list(compared))], lines)


def _label(key: str, length_m: object) -> str:
    name, unit = (TRAJECTORY_ROWS | ACCURACY_ROWS).get(key, (_NAMES.get(key, key), ''))
    over = f' over {length_m:g} m' if key.startswith('drift') else ''
    of_unit = re.match(r'[^ ,(]+', unit)
    return f'{name}{over} [{of_unit.group()}]' if of_unit else f'{name}{over}'


def _headings(names: Sequence[str]) -> list[str]:
    """Return names of files without their folders, where these still differ."""
    short = [Path(name).name for name in names]
    return [one if short.count(one) == 1 else name for name, one in zip(names, short, strict=True)]


def _text(key: str, value: object) -> str:
    return number_text(key, value) if isinstance(value, (int, float)) else ''
