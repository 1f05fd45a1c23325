"""How a sensor is mounted, and how its ranges err: y = o + d + exp(ψ) e^s (1 − b/|p|) p.

o is where the sensor is said to be, p from there to a point that it shows, in the body frame. ψ
turns the sensor and d moves it, along the body's axes, e^s is the factor of its ranges, and b by
how much it shows those from one landmark too long: seven ``values`` of one sensor (7,), or of each
point's with b (m, 8). y changes with them by

    D = ∂y/∂(ψ, d, s, b) = [−[l]× J(ψ), I, l, −e^s l/|l|],   l = y − o − d.

A residual takes D at the point that is predicted. At the measured one its noise would be in D as
well: seen too far, a point would weigh more than seen too near, and the scale run away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.lie import so3

# Which of range, azimuth and elevation is measured, by kind of point.
MEASURED = np.array(
    [
        [True, True, True],
        [False, True, True],
        [True, False, False],
        [False, True, False],
        [True, True, False],
    ]
)

# Standard deviation of a completed point where not measured: as large as a message may state one.
UNMEASURED_M = 1e3
LEAST_M = 0.05  # least distance of a landmark, metres: its sensor has an extent
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, slots=True)
class Sensed:
    """What sensors showed of m points, before it was corrected by how they err; body frame."""

    sensors: IntArray  # (m,) numbers of the sensors
    origins: FloatArray  # (m, 3) o, metres
    arms: FloatArray  # (m, 3) p, metres
    # (m,) ids of landmarks whose ranges these are and have a bias, −1 for none
    anchors: IntArray
    orientations: FloatArray | None = None  # (m, 3, 3) of tags, zero for none

    def select(self, mask: BoolArray | IntArray) -> Sensed:
        """Return the points that ``mask`` (m,) picks."""
        Z = None if self.orientations is None else self.orientations[mask]
        sensors, anchors = self.sensors[mask], self.anchors[mask]
        return Sensed(sensors, self.origins[mask], self.arms[mask], anchors, Z)


def joined_sensed(parts: list[Sensed]) -> Sensed:
    """Return the points of several parts, one after the other, without orientations."""
    return Sensed(
        np.concatenate([part.sensors for part in parts]),
        np.concatenate([part.origins for part in parts]),
        np.concatenate([part.arms for part in parts]),
        np.concatenate([part.anchors for part in parts]),
    )


def shown_at(values: FloatArray, sensed: Sensed) -> FloatArray:
    """Return y (m, 3), metres, body frame."""
    R, scales = so3.exp(values[..., :3]), np.exp(values[..., 6:7])
    scales = scales * without_bias(sensed.arms, values[..., 7])
    turned = (R @ sensed.arms[:, :, None])[:, :, 0]
    return sensed.origins + values[..., 3:6] + scales * turned


def without_bias(arms: FloatArray, biases: FloatArray) -> FloatArray:
    """Return 1 − b/|p| (m, 1) of shown points p (m, 3), by biases (m,)."""
    lengths = np.maximum(np.linalg.norm(arms, axis=1), LEAST_M)
    shares: FloatArray = (1.0 - biases / lengths)[:, None]
    return shares


def sensitivity(values: FloatArray, arms: FloatArray) -> FloatArray:
    """Return D (m, 3, 8) for points at l = ``arms`` (m, 3) from the sensor."""
    D = np.empty((len(arms), 3, 8))
    lengths = np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), LEAST_M)
    D[:, :, 7] = -np.exp(values[..., 6:7]) / lengths * arms
    D[:, :, :3] = -so3.hat(arms) @ so3.left_jacobian(values[..., :3])
    D[:, :, 3:6], D[:, :, 6] = np.eye(3), arms
    return D


def turning(values: FloatArray) -> FloatArray:
    """Return J(ψ) (…, 3, 8): how orientations exp(ψ) Z turn with the values (…, 7)."""
    turns = np.zeros((*values.shape[:-1], 3, 8))
    turns[..., :3] = so3.left_jacobian(values[..., :3])
    return turns


def directions_of(lines: FloatArray) -> FloatArray:
    """Return unit vectors (m, 3, 3) along lines of sight, in azimuth and in elevation, as rows."""
    lengths = np.linalg.norm(lines, axis=1, keepdims=True)
    along = np.where(lengths > 0.0, lines / np.maximum(lengths, _TINY), [1.0, 0.0, 0.0])
    level = np.hypot(along[:, 0], along[:, 1])
    flat = np.maximum(level, _TINY)
    azimuth = np.column_stack([-along[:, 1] / flat, along[:, 0] / flat, np.zeros(len(lines))])
    azimuth[level < _TINY**0.5] = [0.0, 1.0, 0.0]
    return np.stack([along, azimuth, np.cross(along, azimuth)], axis=1)


def unmeasured_covariances(directions: FloatArray) -> FloatArray:
    """Return (m, 3, 3), m², of all but the rows of ``directions`` (m, 3, 3), unit vectors."""
    unmeasured = np.eye(3) - directions.swapaxes(1, 2) @ directions
    covariances: FloatArray = UNMEASURED_M**2 * unmeasured
    return covariances


def measured_axes(shown: FloatArray, expected: FloatArray, kinds: IntArray) -> BoolArray:
    """Return along which :func:`directions_of` expected lines (m, 3) points are known, (m, 3).

    A landmark expected behind what shows its direction is known not to be there, either.
    """
    measured = MEASURED[kinds]
    behind = measured[:, 1] & (np.einsum('mi,mi->m', shown, expected) < 0.0)
    axes: BoolArray = measured | behind[:, None]
    return axes


def completed_lines(shown: FloatArray, expected: FloatArray, kinds: IntArray) -> FloatArray:
    """Return lines of sight (m, 3) of what is shown, and where that is not measured, expected.

    They are uncertain along the expected line, not along the shown one: that would be turned by
    the noise of each direction, and all landmarks drawn to the robot.
    """
    measured_range, measured_azimuth, measured_elevation = MEASURED[kinds].T
    level = np.hypot(expected[:, 0], expected[:, 1])
    source = np.where(measured_azimuth[:, None], shown, expected)
    azimuth = np.arctan2(source[:, 1], source[:, 0])
    rise = np.arctan2(expected[:, 2], level)
    rise_shown = np.arctan2(shown[:, 2], np.hypot(shown[:, 0], shown[:, 1]))
    elevation = np.where(measured_elevation, rise_shown, rise)
    flat, up = np.cos(elevation), np.sin(elevation)
    directions = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up])
    lengths = np.linalg.norm(np.where(measured_range[:, None], shown, expected), axis=1)
    lines: FloatArray = lengths[:, None] * directions
    return lines
