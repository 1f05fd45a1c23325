"""How well the simulated robot was localised, as Nav2 would have seen it."""

from __future__ import annotations

from dataclasses import dataclass

from hall_robot import error_of, Estimated, HallRobot, Seen
import numpy as np
from rich.console import Console

from slam_observer_ros.cli.console import table_of
from slam_observer_ros.common.types import FloatArray

MAX_ERROR_M, MAX_ERROR_RAD = 0.15, 0.08  # of the RMS; with the noise of the hall it is a third
MAX_NOTICED_S = 10.0  # a robot that was carried has to notice that first
FOUND_M = 0.5  # from there on it is where it was put
MIN_RATE = 0.9  # of what is asked for; less says something of the machine alone


@dataclass
class Interruption:
    """What happens half-way: the observer is restarted, or the robot carried.

    Simulated times of when that was, and from when on the robot was localised again, seconds; None
    until then.
    """

    planned_s: float
    is_carried: bool = False
    began_s: float | None = None
    localised_s: float | None = None

    @property
    def moved_s(self) -> float:
        """For how long the robot moved before it was localised again; its time stood still."""
        return (self.localised_s or 0.0) - (self.began_s or 0.0)

    def is_lost(self, time_s: float) -> bool:
        """Return whether the robot is not expected to know where it is."""
        is_since = self.began_s is not None and time_s > self.began_s
        return is_since and (self.localised_s is None or time_s < self.localised_s)

    def note(self, last: Seen) -> None:
        """Note whether the robot is localised again: where it is, if it was carried."""
        if last.by_tf is None or not self.is_lost(last.time_s):
            return
        if self._is_found(last.truth, last.by_tf):
            self.localised_s = last.time_s

    def back_after_s(
        self, seen: list[Seen], estimated: list[Estimated], enough: int
    ) -> float | None:
        """Return for how long it saw enough landmarks before it was localised; None if never.

        That is by stamps of poses, which don't depend on how busy the machine is.
        """
        if self.began_s is None or self.localised_s is None:
            return None
        began_s = self.began_s
        after = (each for each in estimated if each.time_s > began_s)
        found = (each.time_s for each in after if self._is_found(each.truth, each.pose))
        found_s = next(found, self.localised_s)
        times = (s.time_s for s in seen if s.time_s > began_s and s.landmarks >= enough)
        return max(0.0, found_s - next(times, found_s))

    def _is_found(self, truth: FloatArray, pose: FloatArray) -> bool:
        off_m = np.linalg.norm(error_of(truth, pose)[:2])
        return not self.is_carried or bool(off_m < FOUND_M)


def report(robot: HallRobot, interruption: Interruption, rate_hz: float, console: Console) -> bool:
    """Print what came of the run; return whether it is as it should be."""
    is_known = [not interruption.is_lost(each.time_s) for each in robot.seen]
    located = [
        (each.truth, each.by_tf)
        for each, known in zip(robot.seen, is_known, strict=True)
        if known and each.by_tf is not None
    ]
    estimated = [each for each in robot.estimated if not interruption.is_lost(each.time_s)]
    if not located or not estimated:
        console.print('robot: it was never localised', style='red')
        return False
    kind, enough = robot.world.kind, robot.world.enough
    one, most = kind.removesuffix('s'), max(each.landmarks for each in robot.seen)
    few = f'{enough} {kind}' if enough > 1 else one
    in_view = f'{most} {kind} in view at most' if most > 1 else f'one {one} in view at a time'
    errors = np.array([error_of(*poses) for poses in located])
    position_m, heading_rad = _rms(errors[:, :2]), _rms(errors[:, 2:])
    sigma_m, sigma_rad, anees = _consistency(estimated)
    first_s = next(each.time_s for each in robot.seen if each.landmarks >= enough)
    back_s = interruption.back_after_s(robot.seen, robot.estimated, enough)
    reached_hz = _rate_hz(robot.corrections_s)
    what = 'carried' if interruption.is_carried else 'restarted'
    console.print(
        table_of(
            f'{robot.time_s:g} s in a hall with {in_view}',
            {
                'lost until': f'{robot.corrections_s[0] - first_s:.2f} s after the first {few} '
                'in view',
                'map → odom': f'{reached_hz:.1f} a second, of {rate_hz:g} asked for',
                'position error by /tf': f'{position_m:.3f} m RMS, '
                f'{np.linalg.norm(errors[:, :2], axis=1).max():.3f} m at most; σ {sigma_m:.3f} m',
                'heading error by /tf': f'{heading_rad:.4f} rad RMS, '
                f'{np.abs(errors[:, 2]).max():.4f} rad at most; σ {sigma_rad:.4f} rad',
                'ANEES of amcl_pose': f'{anees:.2f} (1 is consistent)',
                f'{what} at {interruption.planned_s:g} s': 'not localised again'
                if back_s is None
                else f'localised again {interruption.moved_s:.2f} s after it drove on, '
                f'by what it saw {back_s:.2f} s after the next {few}',
            },
        )
    )
    is_good = (
        position_m < MAX_ERROR_M
        and heading_rad < MAX_ERROR_RAD
        and back_s is not None
        and back_s <= (MAX_NOTICED_S if interruption.is_carried else robot.world.back_within_s)
    )
    if reached_hz < MIN_RATE * rate_hz:
        console.print('The machine is too slow for this: try a smaller --real-time-factor.')
    console.print('The robot was localised.' if is_good else 'That is not as it should be.')
    return is_good


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _consistency(estimated: list[Estimated]) -> tuple[float, float, float]:
    """Return mean σ of position and heading, and the ANEES in the plane."""
    planar = np.ix_([0, 1, 5], [0, 1, 5])
    covariances = np.array([each.covariance[planar] for each in estimated])
    errors = np.array([error_of(each.truth, each.pose) for each in estimated])
    nees = np.einsum('ni,ni->n', errors, np.linalg.solve(covariances, errors[:, :, None])[..., 0])
    variances = np.trace(covariances[:, :2, :2], axis1=1, axis2=2)
    sigma_rad = np.sqrt(covariances[:, 2, 2]).mean()
    return float(np.sqrt(variances).mean()), float(sigma_rad), float(nees.mean() / 3.0)


def _rate_hz(times_s: list[float]) -> float:
    """Return the median rate over whole seconds in which any came: not the ones of a restart."""
    counts = np.bincount(np.array(times_s).astype(int))
    return float(np.median(counts[counts > 0]))
