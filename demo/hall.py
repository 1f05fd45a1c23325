"""A hall with AprilTags or radios on its walls, or reflectors, and what a robot measures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3

LAP_S = 48.0
"""Simulated time for one lap about the hall, at about half a metre a second."""

TAG_SPOTS = (
    (-6.0, -2.5, 1.0), (-6.0, 0.0, 0.8), (-6.0, 2.5, 1.2), (6.0, -2.5, 1.2), (6.0, 0.0, 0.9),
    (6.0, 2.5, 1.0), (-4.0, -4.0, 1.0), (-1.5, -4.0, 1.2), (1.5, -4.0, 0.8), (4.0, -4.0, 1.0),
    (-4.0, 4.0, 0.8), (-1.5, 4.0, 1.0), (1.5, 4.0, 1.2), (4.0, 4.0, 1.0),
)  # fmt: skip
"""Centres of the tags on the walls x = ±6 m and y = ±4 m, metres."""

CAMERA = se3.pose(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.2, 0.0, 0.5])
)
"""Pose of the camera's optical frame in the base, (4, 4)."""

HALF_WIDTH, HALF_HEIGHT = np.tan(np.radians(35.0)), np.tan(np.radians(27.0))
"""Edges of the image, at distance one."""

MAX_RANGE_M = 6.0
MIN_FRONTAL = np.cos(np.radians(65.0))
"""Least cosine between a tag's normal and the line of sight, at which it can be read."""

REFLECTORS = 500
HALL_M = np.array([180.0, 90.0])  # one reflector in 32 m²
LAP_SPACE_M = 20.0  # from the middle of the lap to the walls of that hall, at least
SCAN_RANGE_M, SCAN_SHARE = 15.0, 0.7
SCAN_NOISE_M, SCAN_NOISE_RAD = 0.02, 0.003

ANCHOR_SPOTS = (
    (-6.0, -4.0, 2.4), (6.0, -4.0, 2.0), (6.0, 4.0, 2.4), (-6.0, 4.0, 2.0), (0.0, -4.0, 2.6),
    (-6.0, 1.0, 1.6),
)  # fmt: skip
"""Where the radios are, metres: not on both sides of a line that the lap is the same about."""

RANGE_NOISE_M, RANGE_SCALE = 0.1, 1.03
DETOUR_SHARE, DETOUR_M = 0.2, 1.0
"""Share of the distances that were measured through a wall, and by how much they are too long, in
the mean of an exponential distribution."""

TAG_SIZE_M = 0.16
FOCAL_LENGTH_PX, PIXEL_NOISE_PX = 600.0, 0.5
"""By which the range r of a tag, known from its size s in the image, is off by σ r² / (f s)."""

BEARING_NOISE_RAD, ORIENTATION_NOISE_RAD = 0.005, 0.05
"""Standard deviations across the line of sight, with the camera's calibration; of the tag."""

ERROR_TIME_S = 2.0
"""How long a landmark is seen off by about the same, as light and view hardly change."""

WHEEL_NOISE = 0.02
"""Of turning and of driving, rad/√s and m/√s: what slips at random."""


def true_pose(time_s: float) -> FloatArray:
    """Return the pose (4, 4) of the base in the map."""
    x, y = _position(time_s)
    dx, dy = _slope(time_s)
    return se3.from_rpy((x, y, 0.0, 0.0, 0.0, float(np.arctan2(dy, dx))))


def tag_poses() -> FloatArray:
    """Return the poses (k, 4, 4) of the tags in the map; z points out of the wall."""
    poses = []
    for x, y, z in TAG_SPOTS:
        normal = np.array([-np.sign(x), 0.0, 0.0] if abs(x) == 6.0 else [0.0, -np.sign(y), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        axes = np.column_stack([np.cross(up, normal), up, normal])
        poses.append(se3.pose(axes, np.array([x, y, z])))
    return np.array(poses)


def reflectors(random: np.random.Generator) -> FloatArray:
    """Return points (n, 3) of a hall somewhere in which the lap is, metres."""
    low = random.uniform(-HALL_M + LAP_SPACE_M, -LAP_SPACE_M)
    return np.column_stack(
        [random.uniform(low, low + HALL_M, (REFLECTORS, 2)), np.zeros(REFLECTORS)]
    )


def scan(
    pose: FloatArray, points: FloatArray, errors: FloatArray, random: np.random.Generator
) -> FloatArray:
    """Return where a laser scanner at a pose (4, 4) sees some of points (n, 3), base frame.

    ``errors`` (n, 7) are SightErrors', along the line of sight and to its left.
    """
    points = se3.transform(se3.inverse(pose), points)
    ranges_m = np.linalg.norm(points, axis=1, keepdims=True)
    is_seen = (ranges_m[:, 0] < SCAN_RANGE_M) & (random.random(len(points)) < SCAN_SHARE)
    points, ranges_m = points[is_seen], ranges_m[is_seen]
    along, across = errors[is_seen, :2].T[:, :, None]
    left = points[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]  # as long as the range
    noise = SCAN_NOISE_M / ranges_m * along * points + SCAN_NOISE_RAD * across * left
    return np.asarray(points + noise)


def ranges(pose: FloatArray, anchors: FloatArray, random: np.random.Generator) -> FloatArray:
    """Return how far radios (n, 3) seem to be from a receiver at a pose (4, 4): (n,), metres."""
    ranges_m = RANGE_SCALE * np.linalg.norm(anchors - pose[:3, 3], axis=1)
    ranges_m += random.normal(0.0, RANGE_NOISE_M, len(anchors))
    is_long = random.random(len(anchors)) < DETOUR_SHARE
    return np.asarray(ranges_m + is_long * random.exponential(DETOUR_M, len(anchors)))


@dataclass
class WheelOdometry:
    """Wheels whose radius and track are not quite known, and that slip at random."""

    random: np.random.Generator
    forward_scale: float = 1.02
    turn_scale: float = 0.97
    pose: FloatArray = field(default_factory=lambda: np.eye(4))  # (4, 4) of the base in odom
    forward_m_s: float = 0.0
    turn_rad_s: float = 0.0

    def advance(self, before: FloatArray, after: FloatArray, dt_s: float) -> None:
        """Measure the motion between two true poses (4, 4)."""
        motion = se3.log(se3.inverse(before) @ after) / dt_s
        noise = self.random.standard_normal(2) / np.sqrt(dt_s)
        self.turn_rad_s = self.turn_scale * motion[2] + WHEEL_NOISE * noise[0]
        self.forward_m_s = self.forward_scale * motion[3] + WHEEL_NOISE * noise[1]
        measured = np.array([0.0, 0.0, self.turn_rad_s, self.forward_m_s, 0.0, 0.0])
        self.pose = self.pose @ se3.exp(measured * dt_s)


class SightErrors:
    """By what each of ``count`` landmarks is seen off, in standard deviations (k, 7).

    A tag across the image, along the line of sight, and turned. The errors change as time goes by,
    but slowly: a robot that sees a landmark ten times a second knows hardly more than by once.
    """

    def __init__(self, random: np.random.Generator, count: int) -> None:
        self._random = random
        self.values: FloatArray = random.standard_normal((count, 7))

    def go_on(self, dt_s: float) -> None:
        """Let some of the errors be new (Gauss–Markov)."""
        kept = np.exp(-dt_s / ERROR_TIME_S)
        new = self._random.standard_normal(self.values.shape)
        self.values = kept * self.values + np.sqrt(1.0 - kept**2) * new


def sightings(
    pose: FloatArray, tags: FloatArray, errors: FloatArray, tag_size_m: float = TAG_SIZE_M
) -> dict[int, FloatArray]:
    """Return which of ``tags`` (k, 4, 4) are in view of a robot at ``pose`` (4, 4).

    From ids to poses (4, 4) in the camera's optical frame; ``errors`` (k, 7) are SightErrors'.
    """
    seen = {}
    for tag_id, tag in enumerate(se3.inverse(pose @ CAMERA) @ tags):
        if _is_in_view(tag):
            seen[tag_id] = _measured(tag, errors[tag_id], tag_size_m)
    return seen


def _is_in_view(tag: FloatArray) -> bool:
    x, y, z = tag[:3, 3]
    range_m = np.linalg.norm(tag[:3, 3])
    return bool(
        z > 0.3
        and range_m < MAX_RANGE_M
        and abs(x) < HALF_WIDTH * z
        and abs(y) < HALF_HEIGHT * z
        and -tag[:3, 2] @ tag[:3, 3] > MIN_FRONTAL * range_m
    )


def _measured(tag: FloatArray, errors: FloatArray, tag_size_m: float) -> FloatArray:
    position = tag[:3, 3]
    range_m = float(np.linalg.norm(position))
    along = position / range_m
    off = errors[:3] * BEARING_NOISE_RAD * range_m
    range_noise_m = PIXEL_NOISE_PX * range_m**2 / (FOCAL_LENGTH_PX * tag_size_m)
    off += along * (range_noise_m * errors[3] - along @ off)
    turned = so3.exp(errors[4:] * ORIENTATION_NOISE_RAD) @ tag[:3, :3]
    return se3.pose(turned, position + off)


def _position(time_s: float) -> tuple[float, float]:
    angle = 2.0 * np.pi * time_s / LAP_S
    return 4.2 * np.cos(angle), 2.2 * np.sin(angle) + 0.4 * np.sin(3.0 * angle)


def _slope(time_s: float) -> tuple[float, float]:
    angle = 2.0 * np.pi * time_s / LAP_S
    return -4.2 * np.sin(angle), 2.2 * np.cos(angle) + 1.2 * np.cos(3.0 * angle)
