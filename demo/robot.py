"""``make robot``: a simulated robot is localised among tags, radios or codes, as for Nav2.

It drives about a hall with AprilTags or radios on its walls, or reflectors in it, or over codes on
its floor: lost at first, its localisation restarted in the middle, or the robot itself carried
elsewhere. Over DDS, the observer is started as
``localization.launch.py`` does it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import replace
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import threading
import time

import floor
import hall
from hall_robot import HallRobot, ODOMETRY_HZ, World
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.progress import Progress
from robot_report import Interruption, report

from slam_observer_ros.common.errors import SlamObserverError
from slam_observer_ros.common.process import StopSignal
from slam_observer_ros.lie import so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import write_map
from slam_observer_ros.nodes.launch_setup import command_line, EXECUTABLE
from slam_observer_ros.settings.estimator_settings import Settings

PARAMS_FILE = 'config/tags_on_tf.yaml'
LAUNCH_ARGUMENTS = {'map_file': 'hall.yaml', 'twist': 'odom', 'use_sim_time': 'true'}
"""Arguments of the launch file, beside ``params_file``."""

RATE_HZ = 20.0
"""Rate of map → odom that is asked for, in simulated time."""

SURVEY_SIGMA_M, SURVEY_SIGMA_RAD = 0.01, 0.02
START_LIMIT_S = 60.0
DISCOVERY_S = 1.0
STOP_LIMIT_S = 10.0
END_S = 1.0
RANGE_NOISE_M = 2.0 * hall.RANGE_NOISE_M
"""As it is stated: short detours pass for noise."""

FOUND_BY_RANGES_S = 20.0
"""Time of driving by which distances say where the robot is, as it has to turn for that."""


class RobotError(SlamObserverError):
    """The run can't be made."""


class Observer:
    """The process of the observer, which can be ended and started again."""

    def __init__(self, folder: Path, options: argparse.Namespace, world: World) -> None:
        self._log = folder / f'{EXECUTABLE}.log'
        is_on_tf = world.sightings is not None
        self._input = "TFMessage on '/tf'" if is_on_tf else "PointCloud2 on '/landmarks'"
        arguments = LAUNCH_ARGUMENTS | {'map_file': str(folder / LAUNCH_ARGUMENTS['map_file'])}
        # The rate is one of wall time, in which the simulation is faster.
        more = ['-p', f'publish_rate:={RATE_HZ * options.real_time_factor}']
        if is_on_tf:
            more += ['-p', 'landmarks_type:=tf']
        if options.keep_pose:
            more += ['-p', f'pose_file:={folder / "pose.yaml"}']
        more += [word for each in world.parameters for word in ('-p', each)]
        self._command = [
            *(sys.executable, '-m', 'slam_observer_ros.nodes.executables', EXECUTABLE),
            *command_line(world.params_file, arguments),
            *more,
        ]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, with its output in a file."""
        with self._log.open('wb') as output:
            self._process = subprocess.Popen(
                self._command, stdout=output, stderr=subprocess.STDOUT
            )

    @property
    def hears_robot(self) -> bool:
        """Whether it has subscribed to odometry and landmarks; RobotError if it has ended."""
        if self._process is None or self._process.poll() is not None:
            raise RobotError(f'the observer has ended; see {self._log}')
        text = self._log.read_text(encoding='utf-8', errors='replace')
        return "Odometry on '/odom'" in text and self._input in text

    def end(self) -> None:
        """End it, whatever it does."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main(args: Sequence[str] | None = None) -> int:
    """Make the run; return 0 if the robot was localised as well as it should be."""
    parser = _parser()
    options = parser.parse_args(args)
    if options.uwb and options.carried:
        parser.error('by distances alone a robot does not notice that it was carried')
    console = Console(highlight=False)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        with tempfile.TemporaryDirectory(prefix='slam_observer_robot_') as name:
            robot, interruption = _run(options, Path(name), console)
        return 0 if report(robot, interruption, RATE_HZ, console) else 1
    except SlamObserverError as error:
        console.print(f'robot: {error}', style='red', markup=False)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='robot', description=(__doc__ or '').splitlines()[0])
    parser.add_argument(
        '--duration', type=float, default=300.0, help='simulated seconds (default 300)'
    )
    parser.add_argument(
        '--real-time-factor',
        type=float,
        default=2.0,
        help='simulated seconds a second (default 2)',
    )
    parser.add_argument(
        '--keep-pose', action='store_true', help='let the observer keep its pose over the restart'
    )
    landmarks = parser.add_mutually_exclusive_group()
    landmarks.add_argument(
        '--reflectors',
        action='store_true',
        help=f'see reflectors without ids, {hall.REFLECTORS} in a large hall, in place of tags',
    )
    landmarks.add_argument(
        '--floor-codes',
        action='store_true',
        help='see codes on the floor, one at a time, by a camera that looks down, in their place',
    )
    landmarks.add_argument(
        '--uwb',
        action='store_true',
        help=f'measure the distances of {len(hall.ANCHOR_SPOTS)} radios, all 3 % too long and one '
        'in five through a wall, in their place',
    )
    parser.add_argument(
        '--carried',
        action='store_true',
        help='carry the robot to another place half-way, in place of the restart',
    )
    parser.add_argument('--seed', type=int, default=0, help='of what is random (default 0)')
    return parser


def _run(
    options: argparse.Namespace, folder: Path, console: Console
) -> tuple[HallRobot, Interruption]:
    """Drive, restarting the observer half-way, or carrying the robot."""
    stop = StopSignal()
    stop.begin()
    world = world_of(options)
    write_map(folder / LAUNCH_ARGUMENTS['map_file'], surveyed(world, options.seed), Settings())
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    with ExitStack() as cleanup:
        cleanup.callback(rclpy.try_shutdown)
        robot = HallRobot(options.seed, world)
        cleanup.callback(robot.destroy_node)
        cleanup.enter_context(_listening(robot))
        observer = Observer(folder, options, world)
        cleanup.callback(observer.end)
        observer.start()
        _wait_until_heard(robot, observer)
        interruption = Interruption(options.duration / 2.0, options.carried)
        progress = cleanup.enter_context(Progress(console=console, transient=True))
        task = progress.add_task('driving', total=options.duration)
        due_s = time.monotonic()
        for _ in range(round(options.duration * ODOMETRY_HZ)):
            if stop.is_set:
                raise RobotError('interrupted')
            robot.step()
            progress.update(task, completed=robot.time_s)
            due_s += 1.0 / (ODOMETRY_HZ * options.real_time_factor)
            time.sleep(max(0.0, due_s - time.monotonic()))
            if interruption.began_s is None and robot.time_s >= interruption.planned_s:
                interruption.began_s = robot.time_s
                if options.carried:
                    robot.carry()
                else:
                    _restart(robot, observer)
                due_s = time.monotonic()
            if robot.seen:
                interruption.note(robot.seen[-1])
        time.sleep(END_S)
    return robot, interruption


def world_of(options: argparse.Namespace) -> World:
    """Return the world that the options name."""
    random = np.random.default_rng(options.seed)
    tags = World(
        kind='tags',
        enough=2,
        params_file=PARAMS_FILE,
        landmarks=hall.tag_poses(),
        has_orientations=False,
        true_pose=hall.true_pose,
        lap_s=hall.LAP_S,
        camera=hall.CAMERA,
        steps_per_image=5,
        sightings=hall.sightings,
    )
    if options.reflectors:
        return replace(
            tags,
            kind='reflectors',
            enough=6,
            params_file='config/reflectors.yaml',
            landmarks=hall.reflectors(random),
            sightings=None,
            scan=hall.scan,
        )
    if options.floor_codes:
        return replace(
            tags,
            kind='codes',
            enough=1,
            params_file='config/floor_codes.yaml',
            landmarks=floor.code_poses(random),
            has_orientations=True,
            true_pose=floor.true_pose,
            lap_s=floor.LAP_S,
            camera=floor.CAMERA,
            steps_per_image=2,
            sightings=floor.sightings,
        )
    if options.uwb:
        return replace(
            tags,
            kind='radios',
            enough=len(hall.ANCHOR_SPOTS),
            params_file='config/uwb.yaml',
            landmarks=np.array(hall.ANCHOR_SPOTS),
            sightings=None,
            ranges=hall.ranges,
            parameters=(f'range_noise:={RANGE_NOISE_M}',),
            back_within_s=FOUND_BY_RANGES_S,
        )
    return tags


def surveyed(world: World, seed: int) -> LandmarkMap:
    """Return the map of landmarks as somebody has measured them with a tape."""
    random, count = np.random.default_rng(seed + 1), len(world.landmarks)
    points = world.landmarks[:, :3, 3] if world.sightings else world.landmarks
    points = points + random.normal(0.0, SURVEY_SIGMA_M, points.shape)
    covariances = np.tile(SURVEY_SIGMA_M**2 * np.eye(3), (count, 1, 1))
    known = LandmarkMap(np.arange(count), points, covariances, np.zeros(count, np.int64))
    if not world.has_orientations:
        return known
    off_rad = random.normal(0.0, SURVEY_SIGMA_RAD, (count, 3))
    turned = np.array([so3.exp(off) for off in off_rad]) @ world.landmarks[:, :3, :3]
    sigmas = np.full(count, SURVEY_SIGMA_RAD)
    return replace(known, orientations=turned, orientation_sigmas=sigmas)


def _wait_until_heard(robot: HallRobot, observer: Observer) -> None:
    limit_s = time.monotonic() + START_LIMIT_S
    while not (observer.hears_robot and robot.is_heard):
        if time.monotonic() > limit_s:
            raise RobotError(f'the observer does not start within {START_LIMIT_S:g} s')
        time.sleep(0.05)
    time.sleep(DISCOVERY_S)


@contextmanager
def _listening(robot: HallRobot) -> Iterator[None]:
    """Handle messages in a thread of their own, or they would wait for the robot's next step."""
    executor = SingleThreadedExecutor()
    executor.add_node(robot)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield
    finally:
        executor.shutdown()
        thread.join(STOP_LIMIT_S)


def _restart(robot: HallRobot, observer: Observer) -> None:
    """End the observer and start it again; the robot's time stands still meanwhile."""
    observer.end()
    time.sleep(DISCOVERY_S)
    robot.forget_correction()
    observer.start()
    _wait_until_heard(robot, observer)


if __name__ == '__main__':
    sys.exit(main())
