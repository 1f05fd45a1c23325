"""A floor with codes in a grid, and what a robot that drives over them sees by a camera below it.

As in a warehouse: it goes straight from code to code, and turns on the spot above one. One code is
in view at most, and between two of them there is none for most of the way.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3

SPACING_M, COLUMNS, ROWS = 1.0, 9, 5
CORNERS = ((0, 0), (8, 0), (8, 2), (3, 2), (3, 4), (0, 4))
"""Columns and rows of the codes at which the robot turns; the lap ends where it begins."""

SPEED_M_S, ACCELERATION_M_S2 = 1.0, 0.5
TURN_RATE_RAD_S = 1.0  # the mean of a turn, which begins and ends at rest
WANDER_M = 0.03
"""How far the robot leaves the line of codes on its way along it, to one side or the other."""

HEIGHT_M = 0.25
CODE_SIZE_M = 0.05
FOCAL_LENGTH_PX, HALF_IMAGE_PX = 600.0, np.array([320.0, 240.0])
PIXEL_NOISE_PX = 1.0  # of a corner: as sharp as the image of a floor that passes by is

CAMERA = se3.pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, HEIGHT_M]))
"""Pose (4, 4) of the optical frame in the base as /tf has it: x forward, z down."""

MOUNT_OFF = se3.from_rpy((0.004, -0.003, 0.0, 0.0, 0.0, np.radians(1.0)))
"""How the camera is mounted against what /tf says of it, (4, 4)."""

_CODE_CORNERS = 0.5 * CODE_SIZE_M * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def code_poses(random: np.random.Generator) -> FloatArray:
    """Return the poses (k, 4, 4) of the codes in the map, put down by hand.

    Their z looks up, and x to where the code has its right side; they are turned by right angles,
    as whoever puts them down does not look at that.
    """
    columns, rows = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    turns = 0.5 * np.pi * random.integers(0, 4, columns.size)
    middle = 0.5 * SPACING_M * np.array([COLUMNS - 1, ROWS - 1])
    places = SPACING_M * np.column_stack([columns.ravel(), rows.ravel()]) - middle
    return np.array(
        [
            se3.from_rpy((x, y, 0.0, 0.0, 0.0, turn))
            for (x, y), turn in zip(places, turns, strict=True)
        ]
    )


def _lap() -> list[tuple[float, FloatArray, float, float]]:
    """Return of each leg how long it takes, where it begins (2,), its direction and length."""
    middle = 0.5 * np.array([COLUMNS - 1, ROWS - 1])
    ends = SPACING_M * (np.array([*CORNERS, CORNERS[0]]) - middle)
    legs = []
    for begin, end in pairwise(ends):
        length_m = float(np.linalg.norm(end - begin))
        direction = float(np.arctan2(*(end - begin)[::-1]))
        duration_s = length_m / SPEED_M_S + SPEED_M_S / ACCELERATION_M_S2
        legs.append((duration_s, begin, direction, length_m))
    return legs


_LEGS = _lap()
_TURNS_RAD = [
    float((after[2] - before[2] + np.pi) % (2.0 * np.pi) - np.pi)
    for before, after in pairwise([*_LEGS, _LEGS[0]])
]
LAP_S = sum(leg[0] for leg in _LEGS) + sum(abs(turn) for turn in _TURNS_RAD) / TURN_RATE_RAD_S
"""Simulated time for one lap."""


def true_pose(time_s: float) -> FloatArray:
    """Return the pose (4, 4) of the base in the map."""
    time_s %= LAP_S
    for number, ((duration_s, begin, direction, length_m), turn_rad) in enumerate(
        zip(_LEGS, _TURNS_RAD, strict=True)
    ):
        ahead = np.array([np.cos(direction), np.sin(direction)])
        left = np.array([-ahead[1], ahead[0]])
        if time_s < duration_s:
            gone_m = _gone_m(time_s, duration_s, length_m)
            side_m = WANDER_M * (-1.0) ** number
            phase = 2.0 * np.pi * gone_m / length_m
            x, y = begin + gone_m * ahead + 0.5 * side_m * (1.0 - np.cos(phase)) * left
            slope = np.pi * side_m / length_m * np.sin(phase)
            return se3.from_rpy((x, y, 0.0, 0.0, 0.0, direction + float(np.arctan(slope))))
        time_s -= duration_s
        turning_s = abs(turn_rad) / TURN_RATE_RAD_S
        if time_s < turning_s:
            share = 0.5 - 0.5 * np.cos(np.pi * time_s / turning_s)
            x, y = begin + length_m * ahead
            return se3.from_rpy((x, y, 0.0, 0.0, 0.0, direction + share * turn_rad))
        time_s -= turning_s
    return true_pose(0.0)  # by rounding, at the very end


def _gone_m(time_s: float, duration_s: float, length_m: float) -> float:
    """Return how far the robot has gone on a leg: it begins and ends at rest."""
    left_s = duration_s - time_s
    speeding_s = SPEED_M_S / ACCELERATION_M_S2
    if time_s < speeding_s:
        return 0.5 * ACCELERATION_M_S2 * time_s**2
    if left_s < speeding_s:
        return length_m - 0.5 * ACCELERATION_M_S2 * left_s**2
    return SPEED_M_S * (time_s - 0.5 * speeding_s)


def sightings(pose: FloatArray, codes: FloatArray, errors: FloatArray) -> dict[int, FloatArray]:
    """Return which of ``codes`` (k, 4, 4) are in view of a robot at ``pose`` (4, 4): one or none.

    From ids to poses (4, 4) in the camera's optical frame; ``errors`` (k, 7) are SightErrors'.
    """
    seen = {}
    in_camera = se3.inverse(pose @ MOUNT_OFF @ CAMERA) @ codes
    for number in np.flatnonzero(np.linalg.norm(in_camera[:, :2, 3], axis=1) < HEIGHT_M):
        code = in_camera[number]
        corners = se3.transform(code, _CODE_CORNERS)
        pixels = FOCAL_LENGTH_PX * corners[:, :2] / corners[:, 2:]
        if (np.abs(pixels) < HALF_IMAGE_PX).all():
            seen[int(number)] = _measured(code, errors[number])
    return seen


def _measured(code: FloatArray, errors: FloatArray) -> FloatArray:
    """Return the pose of a code as its corners in the image have it."""
    pixel_m = PIXEL_NOISE_PX * HEIGHT_M / FOCAL_LENGTH_PX
    turned_rad = pixel_m / (np.sqrt(2.0) * CODE_SIZE_M)  # and its range by as much of it
    tilted_rad = 2.0 * HEIGHT_M / CODE_SIZE_M * pixel_m / CODE_SIZE_M
    off_m = errors[:3] * [0.5 * pixel_m, 0.5 * pixel_m, turned_rad * HEIGHT_M]
    turned = so3.exp(errors[4:] * [tilted_rad, tilted_rad, turned_rad])
    return se3.pose(turned @ code[:3, :3], code[:3, 3] + off_m)
