#!/usr/bin/env python3
"""Write the documentation's tables: parameters from their typed tables, topics from the nodes.

Between ``<!-- table: NAME -->`` and ``<!-- end -->`` a page holds what is generated here.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
import json
import math
import os
from pathlib import Path
import re
import sys
from typing import get_args

# Nothing outside may be heard here, nor hear these nodes. Read when rclpy starts.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy

from slam_observer_ros.nodes.observer_nodes import ObserverNode
from slam_observer_ros.nodes.simulator import SimulatorNode
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import (
    AUTO,
    InputSettings,
    ManagedNodeSettings,
    message_types,
    ObserverNodeSettings,
    Role,
    SimulatorNodeSettings,
)
from slam_observer_ros.settings.parameter_table import Parameter, table
from slam_observer_ros.simulation import Scenario

CHECKOUT = Path(__file__).resolve().parent.parent
PAGES = ('docs/parameters.md', 'docs/topics.md')
BLOCK = re.compile(r'(<!-- table: (?P<name>[\w-]+) -->\n).*?(<!-- end -->)', re.DOTALL)

NAMESPACE = '/robot'
SUBSCRIBE_AT_ONCE = ('velocity_type:=Twist', 'landmarks_type:=PointCloud2', 'use_imu:=true')
OF_EVERY_NODE = ('/rosout', '/parameter_events', '/clock')
# Whose services are of every node, or, those of nav2_msgs, only there where it is installed: a
# sentence below the table has these.
NOT_IN_TABLES = ('rcl_interfaces/', 'type_description_interfaces/', 'nav2_msgs/')

INPUTS = {
    'twist': "the robot's velocity in its own frame",
    'imu': 'the angular velocity, if `use_imu` is set; `twist` then gives only the linear one',
    'landmarks': "landmarks at one instant in the sensor's frame, with ids or without",
    'camera_info': 'of the camera whose detections have pixels alone',
    '/tf': 'sensor poses; `odom_frame` → `base_frame`; fiducials, if asked for',
    '/tf_static': 'sensor poses',
    'initialpose': "where the robot was at its stamp (RViz's *2D Pose Estimate*)",
    '~/set_pose': 'the same, for programs',
    '~/forget_landmark': 'the id of a landmark to forget',
}

TYPES = {'landmarks': 'any of [Message types](#message-types)'}
"""Types of inputs that have too many for a cell."""

OUTPUTS = {
    '~/odometry': "pose in the map, calibrated velocity in the robot's frame",
    'pose': 'pose in the map with its covariance',
    'path': 'at most `path_length` poses so far, 0.1 s apart or more',
    'landmark_map': 'landmarks seen `confirmations` times or more: ids, and covariances where the '
    'gains know them',
    'landmark_estimates': 'the same as PointCloud; not published if an id is 2²⁴ or more, beyond '
    'its float32',
    'markers': 'for RViz and Foxglove: landmarks (pink: elsewhere in another map that fits), '
    'residuals, circles for distances and lines for '
    "directions alone, the first 200 landmarks' ids and 3σ ellipsoids; while the robot is lost in "
    'a map, arrows at the places that fit',
    'lyapunov': 'L (34) of the last observation',
    '/tf': '`map_frame` → `odom_frame` where others publish `odom_frame` → `base_frame`, '
    'otherwise `map_frame` → `base_frame`',
    '~/is_localised': 'whether the pose is known, for behaviour trees: in the loaded map if there '
    'is one, within `position_error` and `heading_error`, not contradicted by all in view',
    '/diagnostics': "rates, ages, counts, problems, the velocity's calibration",
}

SERVICES = {
    '~/reset': 'forget the motion and what was mapped, and start again',
    '~/pause': 'hold the pose and drop what comes in',
    '~/resume': 'end the pause; the robot is where its odometry on /tf has brought it',
    '~/save_map': 'write the map to `map_path`',
    '~/load_map': 'read it from there',
}

SIMULATED = {
    'twist': 'the velocity; TwistStamped with `stamped:=true`',
    'landmarks': 'those in view; PointCloud2 with `landmarks_type:=PointCloud2`',
    'ground_truth/pose': 'the true pose in `truth_frame`',
    'ground_truth/landmarks': 'the true landmarks in `truth_frame`',
}


@dataclass(frozen=True)
class Topic:
    """What a node has on a topic or service."""

    type_name: str
    is_latched: bool = False


@dataclass(frozen=True)
class Interface:
    """Topics and services of a node by relative name."""

    published: dict[str, Topic]
    subscribed: dict[str, Topic]
    services: dict[str, Topic]


def main() -> int:
    """Write the tables, or check them; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument('--check', action='store_true', help='only say which pages are stale')
    choice.add_argument('--json', action='store_true', help='only print what the nodes publish')
    options = parser.parse_args()
    observer = interface_of(ObserverNode, *SUBSCRIBE_AT_ONCE)
    simulator = interface_of(SimulatorNode)
    if options.json:
        published = {**simulator.published, **observer.published}
        print(json.dumps({name: topic.type_name for name, topic in published.items()}))
        return 0
    stale = [page for page in PAGES if is_stale(page, tables(observer, simulator), options.check)]
    for page in stale:
        print(f'{page}: {"stale, run `make docs`" if options.check else "written"}')
    return 1 if options.check and stale else 0


def interface_of(make_node: Callable[[], Node], *parameters: str) -> Interface:
    """Start a node, and return what it has on its topics and services."""
    assignments = [argument for text in parameters for argument in ('-p', text)]
    quiet = ['--log-level', 'warn', '--disable-external-lib-logs']
    rclpy.init(args=['--ros-args', '-r', f'__ns:={NAMESPACE}', *quiet, *assignments])
    node = make_node()
    try:
        return Interface(
            {
                relative_name(publisher.topic_name, node): Topic(
                    type_name(publisher.msg_type),
                    publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                )
                for publisher in node.publishers
                if publisher.topic_name not in OF_EVERY_NODE
            },
            {
                relative_name(subscription.topic_name, node): Topic(
                    type_name(subscription.msg_type)
                )
                for subscription in node.subscriptions
                if subscription.topic_name not in OF_EVERY_NODE
            },
            {
                relative_name(service.srv_name, node): Topic(type_name(service.srv_type))
                for service in node.services
                if not type_name(service.srv_type).startswith(NOT_IN_TABLES)
            },
        )
    finally:
        node.destroy_node()
        rclpy.shutdown()


def relative_name(name: str, node: Node) -> str:
    """Return the name as the node's source has it."""
    private = f'{NAMESPACE}/{node.get_name()}/'
    if name.startswith(private):
        return f'~/{name.removeprefix(private)}'
    return name.removeprefix(f'{NAMESPACE}/')


def type_name(message_class: type) -> str:
    """Return ``package/Type``."""
    return f'{message_class.__module__.split(".")[0]}/{message_class.__name__}'


def tables(observer: Interface, simulator: Interface) -> dict[str, str]:
    """Return the Markdown of every table by its name in the pages."""
    return {
        'inputs': input_table(observer.subscribed),
        'message-types': message_type_table(),
        'outputs': topic_table('topic', observer.published, OUTPUTS),
        'services': topic_table('service', observer.services, SERVICES),
        'simulator-outputs': topic_table('topic', simulator.published, SIMULATED),
        **two_tables('estimator', table(Settings)),
        **two_tables('input', table(InputSettings)),
        **two_tables('observer-node', own_parameters()),
        'managed-node-parameters': parameter_table(table(ManagedNodeSettings)),
        'scenario-parameters': parameter_table(table(Scenario)),
        'simulator-node-parameters': parameter_table(table(SimulatorNodeSettings)),
    }


def input_table(subscribed: dict[str, Topic]) -> str:
    """Return the table of what the observer takes in."""
    expect_same_names(subscribed, INPUTS)
    choices = {row.name: row.choices for row in table(ObserverNodeSettings)}
    types = {name: topic.type_name for name, topic in subscribed.items()} | TYPES
    types['twist'] = ', '.join(t for t in choices['velocity_type'] if t != AUTO)
    return markdown(
        ('topic', 'type', 'what it gives'),
        [(f'`{name}`', types[name], text) for name, text in INPUTS.items()],
    )


def message_type_table() -> str:
    """Return the table of the message types that are read, and as what."""
    rows: dict[tuple[str, str], list[str]] = {}
    for role in get_args(Role):
        for name, known in message_types(role).items():
            rows.setdefault((role, known.package), []).append(f'`{name}`')
    cells = [(role, package, ', '.join(names)) for (role, package), names in rows.items()]
    return markdown(('read as', 'published by', 'types'), cells)


def topic_table(kind: str, topics: dict[str, Topic], texts: dict[str, str]) -> str:
    """Return the table of topics or services, each with its text."""
    expect_same_names(topics, texts)
    rows = [
        (f'`{name}`', topics[name].type_name + ', latched' * topics[name].is_latched, text)
        for name, text in texts.items()
    ]
    return markdown((kind, 'type', 'what it is'), rows)


def expect_same_names(found: Iterable[str], described: Iterable[str]) -> None:
    """Stop unless exactly those that the node has are described."""
    for name in sorted(set(found) ^ set(described)):
        what = 'has no text' if name in set(found) else 'is gone'
        raise SystemExit(f'{name} {what}: {__file__}')


def own_parameters() -> list[Parameter]:
    """Return the rows that the observer node adds to its inputs' rows."""
    inherited = table(InputSettings)
    return [row for row in table(ObserverNodeSettings) if row not in inherited]


def two_tables(name: str, parameters: Sequence[Parameter]) -> dict[str, str]:
    """Return the tables of what a robot needs first, and of the advanced parameters."""
    return {
        f'{name}-parameters': parameter_table(row for row in parameters if row.basic),
        f'{name}-parameters-advanced': parameter_table(r for r in parameters if not r.basic),
    }


def parameter_table(parameters: Iterable[Parameter]) -> str:
    """Return the table of parameters."""
    rows = [
        (f'`{row.name}`', f'`{default_text(row)}` {row.unit}{allowed(row)}', text(row))
        for row in parameters
    ]
    return markdown(('parameter', 'default (allowed)', 'what it is'), rows)


def allowed(row: Parameter) -> str:
    """Return the choices, or the smallest and the largest value, in brackets."""
    if row.choices:
        return f' ({", ".join(row.choices)})'
    ends = [f'{end:g}' if math.isfinite(end) else '' for end in (row.minimum, row.maximum)]
    return f' ({"…".join(ends)})' if any(ends) else ''


def default_text(row: Parameter) -> str:
    """Return the default as YAML has it."""
    if isinstance(row.default, str):
        return row.default or "''"
    return json.dumps(row.default)


def text(row: Parameter) -> str:
    """Return the description, and whether the value may change while the node runs."""
    return row.description + ('' if row.read_only else ' *(live)*')


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ['---'] * len(head), *([cell.replace('|', '\\|') for cell in r] for r in rows)]
    return ''.join(f'| {" | ".join(line)} |\n' for line in lines)


def is_stale(page: str, contents: dict[str, str], only_check: bool) -> bool:
    """Write the tables into a page, or only check; return whether they were not as they are."""
    path = CHECKOUT / page
    old = path.read_text(encoding='utf-8')
    new = BLOCK.sub(lambda m: m[1] + contents[m['name']] + m[3], old)
    if new != old and not only_check:
        path.write_text(new, encoding='utf-8')
    return new != old


if __name__ == '__main__':
    sys.exit(main())
