#!/usr/bin/env python3
"""Draw docs/images/robot.gif: a real robot, localised online among surveyed landmarks.

MRCLAM data set 6, robot 4, in the folder that SLAM_OBSERVER_DATA names: of the motion only the
commands to the wheels are known, and a camera sees one to three coded landmarks at a time. The
robot does not know at first where it is.
"""

from __future__ import annotations

from dataclasses import replace
import os
from pathlib import Path
import sys

import matplotlib as mpl
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.data_sets import load_mrclam
from slam_observer_ros.recordings.trajectory import interpolate, Trajectory
from slam_observer_ros.recordings.writer import DataSet
from slam_observer_ros.runs.figures import PALE_BLUE, RED, STYLE
from slam_observer_ros.runs.metrics import CHI_SQUARE_95
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters

CHECKOUT = Path(__file__).resolve().parent.parent
PICTURE = CHECKOUT / 'docs' / 'images' / 'robot.gif'
CONFIG = CHECKOUT / 'config' / 'mrclam.yaml'
ROBOT, DURATION_S, FRAME_S, TRAIL_FRAMES = 4, 360.0, 2.5, 30
FRAMES_A_SECOND = 10
SURVEY_SIGMA_M = 0.02
ROBOT_M = 0.6  # size of the robot's symbol
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
"""From the data set's axes to the picture's: the hall is long in y."""


class Run:
    """The data set through the estimator, frame by frame, in the frame of the truth."""

    def __init__(self, data_set: DataSet) -> None:
        self.truth = Trajectory(data_set.truth_stamps_ns, data_set.true_poses)
        velocities = zip(
            data_set.velocity_stamps_ns.tolist(), data_set.body_velocities, strict=True
        )
        events = [VelocityEvent(stamp_ns, velocity) for stamp_ns, velocity in velocities]
        both = [*events, *data_set.observations]
        self._events = iter(sorted(both, key=lambda event: event.stamp_ns))
        self.start_ns = max(both[0].stamp_ns, data_set.truth_stamps_ns[0])
        settings = from_parameters(Settings, read_parameter_file(CONFIG))
        # Nothing is held back: in a picture nobody waits.
        settings = replace(settings, reorder_window=0.0, localization_mode='uncertain')
        self.estimator = Estimator(settings)
        self.estimator.load_map(surveyed(data_set))

    def advance(self, time_s: float) -> None:
        """Use the events up to a time of the run."""
        end_ns = self.start_ns + round(time_s * 1e9)
        for event in self._events:
            self.estimator.add(event)
            if event.stamp_ns >= end_ns:
                break
        self.estimator.release()


def main() -> None:
    """Draw the animation."""
    data = Path(os.environ.get('SLAM_OBSERVER_DATA', CHECKOUT / '..' / 'shared' / 'data'))
    folder = data / 'mrclam' / 'MRCLAM_Dataset6'
    if not folder.is_dir():
        sys.exit(f'no data set in {folder}: SLAM_OBSERVER_DATA names the folder of all')
    data_set = load_mrclam(folder, ROBOT)
    run = Run(data_set)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.6, 3.6), dpi=90, layout='constrained')
        axes = figure.add_subplot()
        true: list[np.ndarray] = []
        estimated: list[np.ndarray | None] = []

        def draw(frame: int) -> None:
            run.advance((frame + 1) * FRAME_S)
            estimator = run.estimator
            true.append(interpolate(run.truth, np.array([estimator.stamp_ns]))[0][0])
            estimated.append(estimator.pose if estimator.is_localised else None)
            show(axes, run, data_set, true, estimated)

        frames = round(DURATION_S / FRAME_S)
        animation = FuncAnimation(figure, draw, frames=frames, init_func=list)
        animation.save(PICTURE, PillowWriter(fps=FRAMES_A_SECOND))
    print(f'{PICTURE}: {PICTURE.stat().st_size / 1e6:.2f} MB')


def surveyed(data_set: DataSet) -> LandmarkMap:
    """Return the landmarks as a map."""
    truth = data_set.landmarks
    covariances = np.tile(SURVEY_SIGMA_M**2 * np.eye(3), (len(truth.ids), 1, 1))
    counts = np.zeros(len(truth.ids), dtype=np.int64)
    return LandmarkMap(truth.ids, truth.world_points, covariances, counts)


def show(
    axes: Axes,
    run: Run,
    data_set: DataSet,
    true: list[np.ndarray],
    estimated: list[np.ndarray | None],
) -> None:
    """Draw the present state."""
    axes.clear()
    landmarks = turned(data_set.landmarks.world_points)
    axes.plot(*landmarks.T, 's', color='#555555', markersize=4, label='surveyed landmarks')
    draw_path(axes, true, {'color': PALE_BLUE, 'linewidth': 3.5, 'label': 'true'})
    draw_path(axes, estimated, {'color': RED, 'linewidth': 1.2, 'label': 'estimated, with 95 %'})
    estimator, now = run.estimator, estimated[-1]
    title = f'{len(true) * FRAME_S:3.0f} s: '
    if now is None:
        title += 'lost'
    else:
        error_m = np.linalg.norm(true[-1][:2, 3] - now[:2, 3])
        title += f'position error {100.0 * error_m:.0f} cm'
        rotation = np.eye(3)
        rotation[:2, :2] = TURN
        spread = rotation @ estimator.pose_covariance[3:, 3:] @ rotation.T
        centre = rotation @ now[:3, 3]
        variances, directions = np.linalg.eigh(CHI_SQUARE_95 * spread[:2, :2])
        turn = np.linspace(0.0, 2.0 * np.pi, 37)
        half_axes = directions * np.sqrt(np.maximum(variances, 0.0))
        ellipse = centre[:2, None] + half_axes @ np.stack([np.cos(turn), np.sin(turn)])
        axes.plot(*ellipse, '-', color=RED, linewidth=1.0)
        seen = np.isin(data_set.landmarks.ids, estimator.last_update.ids)
        for point in landmarks[seen]:
            axes.plot(*np.array([centre[:2], point]).T, '-', color='#999999', linewidth=0.8)
    drawn = np.concatenate([landmarks, turned(run.truth.positions)])
    low, high = drawn.min(axis=0) - 1.0, drawn.max(axis=0) + 1.0
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(title)
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, 0.0), ncols=3)


def draw_path(axes: Axes, poses: list[np.ndarray | None], style: dict[str, object]) -> None:
    """Draw the last poses, and the robot at the newest; None where it was lost."""
    gap = np.full(3, np.nan)
    recent = poses[-TRAIL_FRAMES:]
    points = np.array([gap if pose is None else pose[:3, 3] for pose in recent])
    axes.plot(*turned(points).T, '-', **style)
    if (pose := poses[-1]) is not None:
        corners = ROBOT_M * np.array([[0.6, 0.0, 0.0], [-0.4, 0.3, 0.0], [-0.4, -0.3, 0.0]])
        outline = corners @ pose[:3, :3].T + pose[:3, 3]
        axes.fill(*turned(outline).T, color=style['color'], zorder=4)


def turned(points: np.ndarray) -> np.ndarray:
    """Return points (n, 2) in the picture's axes of points (n, 3) in the data set's."""
    return points[:, :2] @ TURN.T


if __name__ == '__main__':
    main()
