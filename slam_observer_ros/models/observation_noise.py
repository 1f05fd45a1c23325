"""Noise of observed points, from the settings or from the messages: covariances (m, 3, 3), m².

And how far the pose of a square tag may be off, as its corners in the image are. With corners that
err by σ px, a focal length f in px and an edge s, at the range r the mean of the four gives the
direction, σ/(2 f), and their spread the range, r² σ/(√2 f s). How the tag is turned about its
normal shows as well as its range; how it is tilted hardly, where it is seen frontally.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.matrices import limited
from slam_observer_ros.lie.sensor_mounting import unmeasured_covariances
from slam_observer_ros.models.point_noise import (
    point_covariances,
    PointFigures,
    repetition_factors,
    stated_covariances,
)
from slam_observer_ros.settings.estimator_settings import Settings

RESOLUTION_RAD = 1e-4  # least standard deviation of an orientation about each axis
LASTING = 0.1  # share of the time a robot has stood for which its sensor's error is taken to last
_TINY = np.finfo(np.float64).tiny
_IDENTITY = np.eye(3)


class ObservationNoise:
    """How far observed points may be off, as ``observation_model`` and its figures say."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.stood_s = 0.0  # for how long the robot has stood now, 0 while it moves
        # The last observation and what its points may be off by: hypotheses ask one after another.
        self._last: tuple[ObservationEvent, FloatArray] | None = None

    def covariances(
        self, event: ObservationEvent, lines_of_sight: FloatArray | None = None
    ) -> FloatArray:
        """Return what an observation's points may be off by, metres squared.

        All can be inverted, even if a message or a point at the sensor itself says that some
        direction is known exactly. ``lines_of_sight`` (m, 3) lead from the sensor to where points
        of unknown covariance should be; default where they were measured.
        """
        if lines_of_sight is None:
            if self._last is None or self._last[0] is not event:
                self._last = event, self.covariances(event, event.lines_of_sight)
            return self._last[1]
        if event.covariances is None:
            return self.at(lines_of_sight)
        stated = event.covariances
        covariances = stated_covariances(event.points, stated, lines_of_sight, self.figures)
        if event.directions is not None:
            covariances += unmeasured_covariances(event.directions)
        return covariances

    @property
    def error_time_s(self) -> float:
        """Correlation time of the errors, see :func:`repetition_factors`.

        What a robot sees from one place has the same error, as light and view stay as they are.
        How slowly that changes nobody knows: it is taken to last for a share of the time for which
        the robot has stood so far, as flicker noise does: the logarithm of its views counts.
        """
        return max(self._settings.observation_correlation_time, LASTING * self.stood_s)

    def repetitions(self, dt_s: FloatArray) -> FloatArray:
        """Return the factors (m,) of points seen before, as :func:`repetition_factors`."""
        return repetition_factors(dt_s, self.error_time_s)

    def orientation_covariances(self, event: ObservationEvent, Z: FloatArray) -> FloatArray:
        """Return what an observation's orientations may be off by (m, 3, 3), rad².

        Of rotation vectors along the event's axes; all can be inverted. ``Z`` (m, 3, 3) are the
        orientations that are expected, or measured where none is.
        """
        settings, stated = self._settings, event.orientation_covariances
        if settings.observation_model == 'fiducial':
            modelled = orientation_covariances(Z, event.lines_of_sight, settings)
        else:
            modelled = np.tile(settings.orientation_noise**2 * _IDENTITY, (len(Z), 1, 1))
        if stated is not None:
            is_stated = stated.any(axis=(1, 2))
            modelled[is_stated] = limited(stated[is_stated], np.full(3, np.pi))
        return modelled + RESOLUTION_RAD**2 * _IDENTITY

    def at(self, lines_of_sight: FloatArray) -> FloatArray:
        """Return what the settings say of points along ``lines_of_sight`` (m, 3)."""
        return point_covariances(lines_of_sight, self.figures)

    @property
    def figures(self) -> PointFigures:
        """How far points may be off, as the settings say now."""
        s = self._settings
        if s.observation_model == 'cartesian':
            return PointFigures(s.point_noise**2, 0.0, 0.0, s.point_noise**2, 0.0)
        if s.observation_model == 'range_bearing':
            return PointFigures(
                s.range_noise**2, s.range_scale_noise**2, 0.0, 0.0, s.bearing_noise**2
            )
        squared = (s.pixel_noise / s.focal_length) ** 2
        if s.observation_model == 'stereo':
            parallax = s.disparity_noise / (s.focal_length * s.stereo_baseline)
            return PointFigures(0.0, 0.0, parallax**2, 0.0, squared)
        # The mean of a tag's four corners, and their spread (see above).
        return PointFigures(0.0, 0.0, 0.5 * squared / s.tag_size**2, 0.0, 0.25 * squared)


_CORNERS = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
LEAST_RANGE = 1.0  # range, in edges of the tag, nearer than which no camera has all of it in view
LARGEST_RANGE = 1e6  # in edges of the tag: beyond, its corners are one point but for rounding
LEAST_NOISE = 1e-6  # noise of corners, in focal lengths, beside which less is lost in rounding


def orientation_covariances(Z: FloatArray, lines_of_sight: FloatArray, s: Settings) -> FloatArray:
    """Return the covariances (m, 3, 3) of tags' orientations, rad², of tags turned by ``Z``.

    As least squares has them: (Jᵀ J)⁻¹ σ² of the corners' derivatives by the pose, without
    position.
    Of tags whose ``Z`` is zero nothing is known.
    """
    covariances = np.tile(np.pi**2 * np.eye(3), (len(Z), 1, 1))
    are_known = Z.any(axis=(1, 2))
    if are_known.any():
        covariances[are_known] = _of_known(Z[are_known], lines_of_sight[are_known], s)
    return covariances


def _of_known(Z: FloatArray, lines_of_sight: FloatArray, s: Settings) -> FloatArray:
    # The camera looks along the line of sight: its axes U, and the corners q in them.
    lengths = np.linalg.norm(lines_of_sight, axis=1, keepdims=True)
    third = lines_of_sight / np.maximum(lengths, _TINY)
    third[~third.any(axis=1)] = (0.0, 0.0, 1.0)
    # Across the axis that it is furthest from.
    first = np.cross(np.eye(3)[np.abs(third).argmin(axis=1)], third)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    U = np.stack([first, np.cross(third, first), third], axis=1)
    arms = s.tag_size * _CORNERS @ (U @ Z).swapaxes(-1, -2)  # (m, 4, 3)
    range_m = np.clip(lengths, LEAST_RANGE * s.tag_size, LARGEST_RANGE * s.tag_size)
    q = arms + range_m[:, None] * np.array([0.0, 0.0, 1.0])
    # f (x, y) / z, by turns and shifts of the tag: dq = dω × arm + dt.
    projected = np.zeros((*q.shape[:2], 2, 3))
    projected[..., 0, 0] = projected[..., 1, 1] = 1.0 / q[..., 2]
    projected[..., 2] = -q[..., :2] / q[..., 2:] ** 2
    J = np.concatenate([projected @ -so3.hat(arms), projected], axis=-1)
    J = s.focal_length * J.reshape(len(Z), 8, 6)
    # What turns are known by once the position is.
    N = J.swapaxes(-1, -2) @ J
    turns = N[:, :3, :3] - N[:, :3, 3:] @ np.linalg.solve(N[:, 3:, 3:], N[:, 3:, :3])
    noise = max(s.pixel_noise, LEAST_NOISE * s.focal_length)
    information = turns / noise**2 + np.eye(3) / np.pi**2  # nothing is off by more
    covariances: FloatArray = U.swapaxes(-1, -2) @ np.linalg.inv(information) @ U
    return covariances
