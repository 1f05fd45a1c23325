"""What nodes and ROS give each other: messages' classes, qualities of service, and parameters.

Classes are imported when they are needed; parameters are declared, checked and read from the typed
tables.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Sequence
from functools import cache
import importlib
from importlib.util import find_spec
from itertools import pairwise
import os
from pathlib import Path
import sys
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterValue,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, QoSProfile

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.messages.outgoing import OutgoingMessages
from slam_observer_ros.nodes.guarded_node import GuardedNode
from slam_observer_ros.settings.parameter_file import misplaced_sections, names_of_others
from slam_observer_ros.settings.parameter_table import (
    Dataclass,
    from_parameters,
    Parameter,
    SettingsT,
    table,
)

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:  # No wheel of it exists; scripts/build_tf2_msgs.py builds it.
    TFMessage = None


@cache
def message_class(type_name: str) -> Any:
    """Import a type such as ``sensor_msgs/msg/Imu``; ParameterError without its package."""
    package, _, name = type_name.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except ImportError as error:
        raise ParameterError(
            f'{type_name} needs the package {package}: {install_command(package)}, or source the '
            'workspace that has it'
        ) from error


def is_installed(type_name: str) -> bool:
    """Return whether the package of a message type is there; it is not imported."""
    return find_spec(type_name.partition('/')[0]) is not None


def install_command(package: str) -> str:
    """Return how a package of the ROS distribution at hand is installed."""
    distribution = os.environ.get('ROS_DISTRO', '$ROS_DISTRO')  # a shell puts it in, too
    return f'apt install ros-{distribution}-{package.replace("_", "-")}'


MESSAGES = OutgoingMessages(message_class, lambda data: array('B', data))
"""Makes what the nodes publish."""


RELIABLE_QOS = QoSProfile(depth=10)
"""Out: any subscriber fits a reliable publisher."""

LATCHED_POSE_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Out: as AMCL's pose; a late subscriber gets the last ones, as many as it keeps itself."""

LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Out: a subscriber that comes late gets the last message."""


INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1


class RepeatableParameters(GuardedNode):
    """A node where setting a parameter to the value that it has is no failure.

    rclpy refuses that for read-only ones, and most of a dumped file are read-only.
    """

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set those parameters that are read-only only where they change, all others as ever."""
        changes = [each for each in parameter_list if not self._is_repeated(each)]
        if parameter_list and not changes:
            return SetParametersResult(successful=True)
        return super().set_parameters_atomically(changes)

    def _is_repeated(self, parameter: RosParameter) -> bool:
        name = parameter.name
        if not self.has_parameter(name) or not self.describe_parameter(name).read_only:
            return False
        present: ParameterValue = self.get_parameter(name).get_parameter_value()
        return bool(parameter.get_parameter_value() == present)


def declare_settings(node: Node, *settings_classes: type[Dataclass]) -> None:
    """Declare every row of the settings' tables; from then on each change is checked.

    Names that are set but in no table are ignored with a warning: they may be other nodes'.

    Raises
    ------
    ParameterError
        If a name that is set is one of ours misspelt.
    InvalidParameterValueException
        If a value that is set does not fit its row.

    """
    rows = [row for settings_class in settings_classes for row in table(settings_class)]
    _check_names(node, [row.name for row in rows])
    _warn_of_misplaced(node, [row.name for row in rows])

    def check(changes: Sequence[RosParameter]) -> SetParametersResult:
        try:
            for settings_class in settings_classes:
                _check_changes(node, settings_class, changes)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)
    for row in rows:
        node.declare_parameter(row.name, row.default, descriptor(row))


def read_settings(node: Node, settings_class: type[SettingsT]) -> SettingsT:
    """Return the settings that the node's parameters hold now."""
    names = [row.name for row in table(settings_class)]
    values = {name: node.get_parameter(name).value for name in names}
    return from_parameters(settings_class, values)


def descriptor(row: Parameter) -> ParameterDescriptor:
    """Return the ROS descriptor of one row.

    The type is left dynamic so that ``gain:=4`` may set a floating-point parameter; our own check
    refuses what does not fit, with a better reason than rclpy's.
    """
    unit = f' [{row.unit}]' if row.unit else ''
    result = ParameterDescriptor(
        name=row.name,
        description=f'{row.description}{unit}',
        additional_constraints=row.range_text(),
        read_only=row.read_only,
        dynamic_typing=True,
    )
    if isinstance(row.default, float):
        result.floating_point_range = [
            FloatingPointRange(from_value=float(row.minimum), to_value=float(row.maximum))
        ]
    elif isinstance(row.default, int) and not isinstance(row.default, bool):
        result.integer_range = [
            IntegerRange(
                from_value=int(max(row.minimum, INT64_MIN)),
                to_value=int(min(row.maximum, INT64_MAX)),
            )
        ]
    return result


def _check_names(node: Node, names: Collection[str]) -> None:
    """Raise ParameterError if a name that is set is misspelt; warn of names unlike any."""
    # rclpy, unlike rclcpp, has no public name for what the command line and files set.
    written = [
        name
        for name in sorted(node._parameter_overrides)
        if not (node.has_parameter(name) or name.startswith('qos_overrides.'))
    ]
    if ignored := names_of_others(written, names):
        node.get_logger().warning(f'unknown parameters are ignored: {", ".join(ignored)}')


def _warn_of_misplaced(node: Node, names: Collection[str]) -> None:
    """Warn of files on the command line whose parameters have the name of another node."""
    full_name = node.get_fully_qualified_name()
    for option, path in pairwise(sys.argv):
        # A pipe, as of a shell's <(...), has been read to its end by ROS: it would block.
        if option != '--params-file' or not Path(path).is_file():
            continue
        try:
            sections = misplaced_sections(Path(path), full_name, names)
        except ParameterError as error:  # though ROS has read it
            node.get_logger().warning(str(error))
            continue
        if sections:
            node.get_logger().warning(
                f"parameter file {path} has nothing for '{full_name}'; are those of "
                f"'{sections[0]}' meant for it?"
            )


def _check_changes(
    node: Node, settings_class: type[Dataclass], changes: Sequence[RosParameter]
) -> None:
    """Raise ParameterError unless the settings with these changes are whole and in range."""
    names = [row.name for row in table(settings_class)]
    values = {name: node.get_parameter(name).value for name in names if node.has_parameter(name)}
    values.update({change.name: change.value for change in changes if change.name in names})
    from_parameters(settings_class, values)
