"""``slam-observer doctor``: what is installed, and what a node makes of the topics alive."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from importlib.util import find_spec
from itertools import islice
import json
import os
import platform
import subprocess
import sys
from typing import Any

import numpy as np

from slam_observer_ros.cli.console import print_json, print_table
from slam_observer_ros.cli.options import find_config, options
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.findings import explained, Finding
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    Event,
    ObservationEvent,
    POINT,
    RANGES,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.filter import core
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_maps
from slam_observer_ros.messages.detections import APRILTAGS
from slam_observer_ros.messages.poses import TRANSFORMS
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.runs.health import of_half_points
from slam_observer_ros.runs.mistakes import is_flat, mistakes
from slam_observer_ros.runs.run_health import of_publishers
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import message_types
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table

LISTENER = 'slam_observer_ros.nodes.live_inputs'
"""The program that hears topics; it is one of its own, as only ``nodes/`` knows ROS."""

PATIENCE_S = 20.0  # time for that to start and to end, beyond the time of listening
COMMON_PACKAGES = ('geometry_msgs', 'nav_msgs', 'sensor_msgs')  # which every ROS has

OPTIONAL_PACKAGES = {
    'rosbags': 'recordings',
    'mcap': 'damaged recordings',
    'matplotlib': 'figures',
    'rich': 'tables in the terminal',
    'argcomplete': 'completion in the shell',
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Say which Python, ROS and packages are found, and which topics with velocities or '
        'landmarks are alive. Topics are heard for some seconds, in the ROS domain of this shell. '
        'Of a recording, say which of the parameter files that come with the package fits it, and '
        'why, and which mistake of the set-up (signs, units, frames) explains it better, '
        'or whether two publish velocities on one topic.'
    )
    options(
        parser,
        """
        recording RECORDING: as replay takes it
        --seconds S: how long to listen (default 3)
        --load-map MAP: map that the robot was in, by which mistakes of the set-up are judged
        --json: print one JSON object
        """,
        recording={'nargs': '?'},
        seconds={'default': 3.0},
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Look, listen and print."""
    if not 0.0 < args.seconds <= 3600.0:
        raise UsageError(f'--seconds takes seconds above 0, up to 3600, not {args.seconds:g}')
    if args.load_map is not None and args.recording is None:
        raise UsageError('--load-map takes a recording, which is judged by the map')
    if args.recording is not None:
        maps = None if args.load_map is None else read_maps(args.load_map)
        with Recording(args.recording) as recording:
            selected = recording.find_topics()
            events = list(islice(recording.events(selected), MOST_EVENTS))
            rivals = list(of_publishers(recording, selected))
        name, why = fitting_file(selected.landmarks.message_type, events)
        findings = mistakes(shipped_settings(name), events, maps)
        if maps is not None:
            findings += of_anchors(shipped_settings(name), events, maps)
        findings = explained([*findings, *rivals])
        if args.json:
            listed = {'findings': [finding.as_json() for finding in findings]}
            print_json({'recording': str(args.recording), 'config': name, 'why': why, **listed})
            return
        named = ', or '.join(f'{finding.what}: {finding.remedy}' for finding in findings)
        rows = {'fits': f'--config {name}', 'because': why}
        rows |= {'mistakes of the set-up': named or 'none found'}
        print_table(str(args.recording), rows)
        return
    installed = _installed()
    has_ros = find_spec('rclpy') is not None
    topics = _topics(args.seconds) if has_ros else []
    if args.json:
        print_json({'installed': installed, 'topics': topics})
        return
    print_table('Installed', installed)
    if not has_ros:
        return
    rows = {topic['topic']: topic['text'] for topic in topics}
    print_table(
        f'Topics heard for {args.seconds:g} s',
        rows or {'none': "with velocities or landmarks; is ROS_DOMAIN_ID the robot's?"},
    )


def _installed() -> dict[str, str]:
    ros = 'not found: recordings and simulations only; source a ROS 2 for the nodes'
    if find_spec('rclpy') is not None:
        name = os.environ.get('ROS_DISTRO', 'wheels from PyPI')
        middleware = os.environ.get('RMW_IMPLEMENTATION', 'the default middleware')
        ros = f'{name}, {middleware}, domain {os.environ.get("ROS_DOMAIN_ID", "0")}'
    found = {
        'slam_observer_ros': __version__,
        'Python': f'{platform.python_version()} ({sys.executable})',
        'ROS': ros,
        'step of the filter': core.description(),
    }
    uses = {'tf2_msgs': 'poses of sensors on /tf'}  # of messages, that may be missing
    for known in (*message_types('velocity').values(), *message_types('landmarks').values()):
        uses[known.name.partition('/')[0]] = known.short_name
    for package, use in uses.items():
        if package not in COMMON_PACKAGES:
            is_there = find_spec(package) is not None
            found[package] = 'installed' if is_there else f'not installed; it is for {use}'
    for package, use in OPTIONAL_PACKAGES.items():
        found[package] = f'not installed; it is for {use}'
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found


def _topics(seconds: float) -> list[dict[str, Any]]:
    """Return what is heard; a UsageError says why nothing could be."""
    command = [sys.executable, '-m', LISTENER, f'{seconds:g}']
    try:
        ended = subprocess.run(
            command, capture_output=True, text=True, timeout=seconds + PATIENCE_S, check=True
        )
    except subprocess.CalledProcessError as error:
        reason = (error.stderr.strip().splitlines() or ['no reason given'])[-1]
        raise UsageError(f'topics could not be heard: {reason}') from error
    except subprocess.TimeoutExpired as error:
        raise UsageError('topics could not be heard: ROS did not start') from error
    heard: list[dict[str, Any]] = json.loads(ended.stdout)
    return heard


MOST_EVENTS = 60_000  # events of a recording that are looked at, from its start
REPEATED = 0.5  # share of velocities that are the one before, beyond which they are commands
FEW = 50  # points of an observation, in the median, up to which they are landmarks and no raw scan
FAR_M = 5.0  # range at which a camera reads hardly a tag, and a laser most of its reflectors
FAR_SHARE = 0.25  # share of the points that are so far where a laser scanner sees them


def shipped_settings(name: str) -> Settings:
    """Return what a shipped parameter file says of the estimator."""
    known = {row.name for row in table(Settings)}
    values = read_parameter_file(find_config(name)).items()
    return from_parameters(Settings, {key: value for key, value in values if key in known})


def of_anchors(
    settings: Settings, events: Sequence[Event], maps: Sequence[LandmarkMap]
) -> list[Finding]:
    """Name anchors whose ranges are off everywhere; the robot is found without a pose first."""
    if all(not isinstance(e, ObservationEvent) or e.kinds is None for e in events):
        return []
    estimator = Estimator(settings)
    estimator.load_map(maps)
    for event in events:
        estimator.add(event)
    estimator.flush()
    problem = estimator.localisation_problem
    return [problem] if problem is not None else of_half_points(estimator.anchor_biases, [])


def fitting_file(kind: str, events: Sequence[Event]) -> tuple[str, str]:
    """Return the name of a shipped parameter file, and in words why it fits a recording.

    ``kind`` is the type of its landmarks; ``events`` are its beginning.
    """
    velocities = np.array(
        [event.body_velocity for event in events if isinstance(event, VelocityEvent)]
    ).reshape(-1, 6)
    seen = [e for e in events if isinstance(e, ObservationEvent) and len(e.ids)]
    flat = is_flat(velocities)
    where = 'the robot stays on a floor' if flat else 'it tilts or climbs: two_d_mode: false'
    kinds = {half for e in seen for half in (e.kinds.tolist() if e.kinds is not None else [POINT])}
    if kinds and POINT not in kinds:
        has_range = not kinds.isdisjoint(RANGES)
        name, what = ('uwb', 'distances') if has_range else ('bearings', 'directions')
        return name, f'landmarks are seen as {what} alone, and {where}'
    if flat and _are_below(seen):
        return 'floor_codes', 'landmarks with ids are below the sensor, and the robot stays there'
    if kind == TRANSFORMS:
        return 'tags_on_tf', f'tags are on /tf, and {where}'
    if kind == APRILTAGS:
        return 'apriltags', f'landmarks are AprilTags, and {where}'
    if not flat:
        return 'stereo_inertial', 'it tilts or climbs, as what is moved by hand or flies'
    if _are_reflectors(seen):
        return (
            'reflectors',
            f'points have no ids, are few, and further away than a camera reads tags; {where}',
        )
    moving = velocities[velocities.any(axis=1)]
    is_repeated = (moving[1:] == moving[:-1]).all(axis=1)
    if len(is_repeated) and np.mean(is_repeated) > REPEATED:
        return (
            'wheeled_bearing_range',
            f'{where}, and its velocities are commands: most are exactly the one before',
        )
    return 'wheeled_robot', f'{where}, and its velocities are measured'


def _are_below(seen: list[ObservationEvent]) -> bool:
    """Return whether a sensor looks down at landmarks with ids."""
    if not seen or any((e.ids == UNKNOWN_ID).any() for e in seen):
        return False
    directions = np.concatenate([e.lines_of_sight for e in seen])
    aside = np.linalg.norm(directions[:, :2], axis=1)
    return bool(np.mean(-directions[:, 2] > aside) > 0.5)


def _are_reflectors(seen: list[ObservationEvent]) -> bool:
    """Return whether landmarks are as a laser scanner sees reflectors."""
    if not seen or any((e.ids != UNKNOWN_ID).any() for e in seen):
        return False
    ranges_m = np.concatenate([np.linalg.norm(e.lines_of_sight, axis=1) for e in seen])
    are_few = np.median([len(e.ids) for e in seen]) <= FEW
    return bool(are_few and np.mean(ranges_m > FAR_M) > FAR_SHARE)
