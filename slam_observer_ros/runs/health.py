"""What diagnostics say of an estimator, live and in the recording of a replay."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Protocol

from slam_observer_ros.common.types import IntArray
from slam_observer_ros.estimates import (
    calibration_problems,
    CalibrationEstimate,
    MotionFactor,
    Update,
)
from slam_observer_ros.messages.outgoing import OutgoingMessages

OK, WARN = 0, 1
"""Levels of diagnostic_msgs/DiagnosticStatus."""


class Diagnosed(Protocol):
    """What is looked at of an :class:`.Estimator`."""

    last_update: Update | None

    @property
    def counts(self) -> Counter[str]: ...  # noqa: D102 (as all below, of the estimator)
    @property
    def dropped(self) -> Counter[str]: ...  # noqa: D102
    @property
    def landmark_ids(self) -> IntArray: ...  # noqa: D102
    @property
    def calibration(self) -> Sequence[CalibrationEstimate]: ...  # noqa: D102
    @property
    def motion_factors(self) -> Sequence[MotionFactor]: ...  # noqa: D102
    @property
    def lyapunov(self) -> float: ...  # noqa: D102
    @property
    def stamp_ns(self) -> int | None: ...  # noqa: D102
    @property
    def velocity_is_stale(self) -> bool: ...  # noqa: D102


def estimator_values(estimator: Diagnosed, dropped: Counter[str]) -> dict[str, str]:
    """Return what was used, what was dropped and why, the map's size, calibration and noise."""
    update = estimator.last_update
    values = {f'used: {kind}': str(count) for kind, count in sorted(estimator.counts.items())}
    values |= {f'dropped: {reason}': str(count) for reason, count in sorted(dropped.items())}
    values['landmarks known'] = str(len(estimator.landmark_ids))
    values['known landmarks seen last'] = str(0 if update is None else len(update.ids))
    values |= {f'calibration: {part.name}': str(part) for part in estimator.calibration}
    values |= {f'noise of {part.name}': str(part) for part in estimator.motion_factors}
    advice = {part.name: part.advice for part in estimator.calibration if part.advice}
    values |= {f'mounting: {name}': text for name, text in advice.items()}
    values['Lyapunov value'] = f'{estimator.lyapunov:.3e}'
    return values


def estimator_warnings(estimator: Diagnosed) -> list[str]:
    """Return what is wrong with the velocity or its noise, by the estimate alone."""
    stale = estimator.stamp_ns is not None and estimator.velocity_is_stale
    warnings = ['no velocity in force: the pose is held'] if stale else []
    warnings += calibration_problems(estimator.calibration)
    return warnings + [part.problem for part in estimator.motion_factors if part.problem]


def diagnostics(
    messages: OutgoingMessages, stamp_ns: int, estimator: Diagnosed, hardware_id: str
) -> Any:
    """Make the diagnostic_msgs/DiagnosticArray of an estimate, named as the node's."""
    warnings = estimator_warnings(estimator)
    values = estimator_values(estimator, estimator.dropped)
    status = messages.make(
        'diagnostic_msgs/msg/DiagnosticStatus',
        level=WARN if warnings else OK,
        name='observer_node: estimate',
        message='; '.join(warnings) or 'running',
        hardware_id=hardware_id,
        values=[
            messages.make('diagnostic_msgs/msg/KeyValue', key=key, value=value)
            for key, value in values.items()
        ],
    )
    header = messages.header(stamp_ns, '')
    return messages.make('diagnostic_msgs/msg/DiagnosticArray', header=header, status=[status])
