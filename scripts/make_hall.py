#!/usr/bin/env python3
"""Make docs/images/reflectors.png: a robot dropped in a hall of reflectors that look alike.

The hall and the scanner are as in ``make robot OPTIONS=--reflectors``. Half-way the robot is
carried elsewhere, which its wheels do not notice.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
import sys

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.runs.figures import (
    BLACK,
    BLUE,
    GREEN,
    legend_below,
    ORANGE,
    RED,
    save,
    STYLE,
)
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table

sys.path.append(str(Path(__file__).resolve().parents[1] / 'demo'))
hall = import_module('hall')

CHECKOUT = Path(__file__).resolve().parent.parent
IMAGE = CHECKOUT / 'docs' / 'images' / 'reflectors.png'
DURATION_S, CARRIED_S, LAP_S, HZ = 40.0, 20.0, 150.0, 10
LAP_SIZE = 8.0  # times that of ``make robot``
CARRIED_BY_S = 0.6 * LAP_S
SURVEY_SIGMA_M = 0.01
LEAST_M = 1e-3  # that the curve of errors shows


@dataclass
class Drive:
    """What came of it, at each step."""

    reflectors: FloatArray  # (n, 3)
    truths: list[FloatArray] = field(default_factory=list)  # (4, 4)
    poses: list[FloatArray | None] = field(default_factory=list)  # (4, 4), None if not known
    scans: list[FloatArray] = field(default_factory=list)  # (m, 3) seen last, map


def main() -> None:
    """Drive, and draw it."""
    run = driven()
    print(f'{draw(run)}: {", ".join(said(run))}')


def driven() -> Drive:
    """Switch the robot on somewhere, drive, and carry it."""
    random = np.random.default_rng(0)
    flat = np.array([1.0, 1.0, 0.0])
    points = random.uniform(-0.5, 0.5, (hall.REFLECTORS, 3)) * [*hall.HALL_M, 0.0]
    surveyed = points + random.normal(scale=SURVEY_SIGMA_M, size=points.shape) * flat
    count = len(points)
    covariances = np.tile(SURVEY_SIGMA_M**2 * np.eye(3), (count, 1, 1))
    estimator = Estimator(settings())
    none: IntArray = np.zeros(count, dtype=np.int64)
    estimator.load_map(LandmarkMap(np.arange(count), surveyed, covariances, none))
    odometry, run, before = hall.WheelOdometry(random), Drive(points), pose_at(0.0)
    errors = hall.SightErrors(random, count)
    for step in range(1, round(DURATION_S * HZ)):
        stamp_ns, carried_s = round(step * 1e9 / HZ), CARRIED_BY_S * (step > CARRIED_S * HZ)
        if step == round(CARRIED_S * HZ) + 1:
            before = pose_at((step - 1) / HZ + carried_s)
        truth = pose_at(step / HZ + carried_s)
        odometry.advance(before, truth, 1.0 / HZ)
        before = truth
        velocity = np.array([0.0, 0.0, odometry.turn_rad_s, odometry.forward_m_s, 0.0, 0.0])
        estimator.add(VelocityEvent(stamp_ns, velocity))
        errors.go_on(1.0 / HZ)
        seen = hall.scan(truth, points, errors.values, random)
        estimator.add(ObservationEvent(stamp_ns, np.full(len(seen), UNKNOWN_ID), seen))
        run.truths.append(truth)
        run.poses.append(estimator.pose if estimator.is_localised else None)
        run.scans.append(seen @ truth[:3, :3].T + truth[:3, 3])
    return run


def settings() -> Settings:
    """Return the settings for a hall of reflectors."""
    names = {row.name for row in table(Settings)}
    given = read_parameter_file(CHECKOUT / 'config' / 'reflectors.yaml')
    chosen = {name: value for name, value in given.items() if name in names}
    return from_parameters(Settings, chosen | {'reorder_window': 0.0})


def pose_at(time_s: float) -> FloatArray:
    """Return the pose (4, 4) on the lap."""
    pose = hall.true_pose(time_s * hall.LAP_S / LAP_S)
    pose[:2, 3] *= LAP_SIZE
    return pose


def errors_m(run: Drive) -> FloatArray:
    """Return how far off the position is (s,), metres, NaN where it is not known."""
    return np.array(
        [
            np.nan if pose is None else float(np.linalg.norm((pose - truth)[:2, 3]))
            for truth, pose in zip(run.truths, run.poses, strict=True)
        ]
    )


def said(run: Drive) -> list[str]:
    """Return in words when the robot was found."""
    is_right = errors_m(run) < 0.5
    carried = round(CARRIED_S * HZ)
    first, again = int(np.argmax(is_right)), int(np.argmax(is_right[carried:]))
    return [
        f'found {(first + 1) / HZ:.2f} s after it was switched on',
        f'and {(again + 1) / HZ:.2f} s after it was carried',
    ]


@mpl.rc_context(STYLE)
def draw(run: Drive) -> Path:
    """Draw the hall from above, and the error over time."""
    figure = Figure(figsize=(7.0, 5.6))
    above, below = figure.subplots(2, 1, height_ratios=(3.0, 1.0))
    draw_hall(above, run)
    times_s = np.arange(1, len(run.truths) + 1) / HZ
    below.semilogy(times_s, np.maximum(errors_m(run), LEAST_M), color=RED)
    below.axvline(CARRIED_S, color=BLACK, ls=':')
    below.annotate('carried', (CARRIED_S, 1.0), xytext=(4, 0), textcoords='offset points')
    below.set(xlabel='time [s]', ylabel='position error [m]', xlim=(0.0, DURATION_S))
    legend_below(figure, above, columns=5)
    return save(figure, IMAGE)


def draw_hall(axes: Axes, run: Drive) -> None:
    """Draw the reflectors, and where the robot was found by which of them."""
    axes.plot(*run.reflectors[:, :2].T, 'o', color='#BBBBBB', markersize=3, label='reflectors')
    path = np.array([truth[:2, 3] for truth in run.truths])
    carried = round(CARRIED_S * HZ)
    for part in (path[:carried], path[carried:]):
        axes.plot(*part.T, color=BLUE, label='_' if part is path[carried:] else None)
    axes.plot([], [], color=BLUE, label='path')
    for first, what in ((0, 'switched on'), (carried, 'put down')):
        at = path[first]
        colour = GREEN if first == 0 else ORANGE
        for point in run.scans[first]:
            axes.plot(*np.array([at, point[:2]]).T, color=colour, lw=0.8)
        axes.plot(*at, 'o', color=colour, markersize=7, label=what)
    axes.annotate('', path[carried], path[carried - 1], arrowprops={'arrowstyle': '->', 'ls': ':'})
    axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal')


if __name__ == '__main__':
    main()
