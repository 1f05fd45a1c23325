"""What came of the demo: figures, a table, and whether the observer converged."""

from __future__ import annotations

from pathlib import Path

from demo_listener import DemoListener
import numpy as np
from rich.console import Console

from slam_observer_ros.cli.console import table_of
from slam_observer_ros.common.errors import significant
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.recordings.trajectory import Trajectory
from slam_observer_ros.runs.figures import plot_configuration, plot_lyapunov
from slam_observer_ros.runs.metrics import Decay, fit_decay, trajectory_errors

CHECKED_S = 60.0  # simulated time at which the observer must have converged
CONVERGED_LOG10 = -10.0  # log10 L below which it has
FLOAT32_FLOOR = 1e-10  # L below which the rounding of the clouds' float32 coordinates is felt


def report(listener: DemoListener, folder: Path, console: Console) -> bool:
    """Draw the figures, print the summary and return whether the observer converged."""
    times_s, lyapunov = listener.times_s, np.array(listener.lyapunov)
    # Both topics carry one message an estimate; only one at the very end may be missing.
    count = min(len(times_s), len(lyapunov))
    times_s, lyapunov = times_s[:count], lyapunov[:count]
    is_known = lyapunov > 0.0
    if not np.any(is_known):
        console.print('The observer has published no estimate.', style='red')
        return False
    times_s, lyapunov = times_s[is_known], lyapunov[is_known]
    decay = fit_decay(times_s, lyapunov, FLOAT32_FLOOR)
    _draw(listener, folder, times_s, lyapunov, decay)
    checked_log10 = float(np.log10(lyapunov[times_s <= CHECKED_S][-1]))
    has_converged = checked_log10 < CONVERGED_LOG10
    rows = {
        'log10 L, first': f'{np.log10(lyapunov[0]):.2f}',
        f'log10 L at {min(CHECKED_S, times_s[-1]):.0f} s': f'{checked_log10:.2f}',
        'log10 L, last': f'{np.log10(lyapunov[-1]):.2f}',
        'slope of log10 L': 'none' if decay is None else f'{decay.slope_per_s:.4f} per second',
        **_accuracy(listener),
        'estimates heard': str(count),
        **{path.name: str(path) for path in sorted(folder.iterdir())},
    }
    console.print(table_of('Demo', rows))
    verdict = 'converged' if has_converged else 'did NOT converge'
    console.print(f'The observer {verdict}.', style='green' if has_converged else 'red')
    return has_converged


def _draw(
    listener: DemoListener,
    folder: Path,
    times_s: FloatArray,
    lyapunov: FloatArray,
    decay: Decay | None,
) -> None:
    plot_lyapunov(folder / 'lyapunov.png', times_s, np.log10(lyapunov), decay)
    estimate, truth = listener.trajectories()
    plot_configuration(
        folder / 'configuration.png',
        estimate,
        truth,
        listener.landmark_tracks(estimate.stamps_ns.tolist()),
        listener.true_landmarks(),
    )


def _accuracy(listener: DemoListener) -> dict[str, str]:
    """Return position errors, each after its own rigid alignment."""
    estimate, truth = listener.trajectories()
    half = len(estimate) // 2
    second_half = Trajectory(estimate.stamps_ns[half:], estimate.poses[half:])
    return {
        'ATE, whole run': f'{significant(trajectory_errors(estimate, truth).ate_rmse_m)} m',
        'ATE, second half': f'{significant(trajectory_errors(second_half, truth).ate_rmse_m)} m',
    }
