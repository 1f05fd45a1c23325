"""What nodes and ROS give each other: guarded callbacks, logs, messages, QoS and parameters.

What a callback raises is logged, and the node goes on. Lines that would be repeated are logged
once in a while, and so is what the layers without ROS log. Messages' classes are imported when
they are needed; parameters are declared, checked and read from the typed tables.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache, wraps
import importlib
from importlib.util import find_spec
from inspect import signature
from itertools import pairwise
import logging
import os
from pathlib import Path
import sys
import time
import traceback
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterValue,
    SetParametersResult,
)
from rclpy.clock import Clock as SteadyClock
from rclpy.clock import ClockType
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.messages.outgoing import OutgoingMessages
from slam_observer_ros.settings.parameter_file import misplaced_sections, names_of_others
from slam_observer_ros.settings.parameter_table import (
    Dataclass,
    from_parameters,
    Parameter,
    SettingsT,
    table,
)

REPORT_PERIOD_S = 10.0  # shortest time between two lines about one subject


class ThrottledLog:
    """A node's log, with one line about each subject in ``REPORT_PERIOD_S``.

    rclpy throttles by line of code: there one topic's report would silence another's. Nothing is
    logged in the first ``quiet_s`` seconds.
    """

    def __init__(self, node: Node, quiet_s: float = 0.0) -> None:
        self._node = node
        self._quiet_until_s = time.monotonic() + quiet_s
        self._next_s: dict[str, float] = {}

    def error(self, subject: str, text: str) -> None:
        """Log an error, unless there was one about the subject lately."""
        if self._is_due(subject):
            self._node.get_logger().error(text)

    def warning(self, subject: str, text: str) -> bool:
        """Log a warning, unless there was one about the subject lately; return whether it is."""
        if is_due := self._is_due(subject):
            self._node.get_logger().warning(text)
        return is_due

    def event(self, kind: str, subject: str, note: str = '', **figures: object) -> Finding:
        """Log a finding of a kind, with a note behind what is wrong, likewise; return it."""
        finding = found(kind, **figures)
        self.warning(subject, finding.text(note))
        return finding

    def info(self, subject: str, text: str) -> None:
        """Log information, unless there was some about the subject lately."""
        if self._is_due(subject):
            self._node.get_logger().info(text)

    def _is_due(self, subject: str) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_s.get(subject, self._quiet_until_s):
            return False
        self._next_s[subject] = now_s + REPORT_PERIOD_S
        return True


PACKAGE_LOGGER = 'slam_observer_ros'


class RosLogHandler(logging.Handler):
    """Gives log records to a node's ROS logger."""

    def __init__(self, ros_logger: RcutilsLogger) -> None:
        super().__init__()
        self._ros_logger = ros_logger

    def emit(self, record: logging.LogRecord) -> None:
        """Log the record at the ROS severity that fits its level."""
        text = self.format(record)
        # One line a severity: rclpy remembers the severity that a line of code logs with.
        if record.levelno >= logging.ERROR:
            self._ros_logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._ros_logger.warning(text)
        else:
            self._ros_logger.info(text)


def forward_logging(ros_logger: RcutilsLogger) -> None:
    """Forward this package's Python log to ``ros_logger`` from level INFO on."""
    logger = logging.getLogger(PACKAGE_LOGGER)
    logger.setLevel(logging.INFO)
    logger.handlers = [RosLogHandler(ros_logger)]


class GuardedNode(Node):  # type: ignore[misc]  # rclpy comes untyped
    """A node whose callbacks may fail: rclpy would end the process."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.failures: Counter[str] = Counter()  # by what the callbacks were called for
        self.last_failure = ''  # what the last one has raised, and where
        self._failure_log = ThrottledLog(self)
        self._steady_clock = SteadyClock(clock_type=ClockType.STEADY_TIME)
        super().__init__(*args, **kwargs)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *args: Any, **kwargs: Any
    ) -> Any:
        """Create a subscription whose callback may fail: the message is not used then."""
        guarded = self.guarded(callback, f"a message on '{topic}'")
        return super().create_subscription(msg_type, topic, guarded, *args, **kwargs)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[..., None], *args: Any, **kwargs: Any
    ) -> Any:
        """Create a timer whose callback may fail: it is called again a period later."""
        what = f'the timer of {callback.__qualname__}'
        return super().create_timer(
            timer_period_sec, self.guarded(callback, what), *args, **kwargs
        )

    def create_steady_timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Create a timer by a steady clock: with use_sim_time ROS's may stand still or jump."""
        # rclpy's executor warns of a clock with eight timers or more.
        return self.create_timer(period_s, callback, clock=self._steady_clock)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Any:
        """Create a service whose callback may fail: the response says so."""

        @wraps(callback)
        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:  # noqa: BLE001
                text = self.note_failure(error, f"a call of '{srv_name}'")
                return _refusal(request, srv_type.Response(), text)

        return super().create_service(srv_type, srv_name, answer, *args, **kwargs)

    def guarded(self, callback: Callable[..., None], what: str) -> Callable[..., None]:
        """Return a callback that notes what the given one raises, when called for ``what``."""

        @wraps(callback)
        def call(*args: Any) -> None:
            try:
                callback(*args)
            except Exception as error:  # noqa: BLE001
                self.note_failure(error, what)

        return call

    def note_failure(self, error: Exception, what: str) -> str:
        """Count and log what was raised by what is called for ``what``; return it as a text.

        While the node is being shut down, which may end anything, it is raised again.
        """
        if not self.context.ok():
            raise error
        self.failures[what] += 1
        self.last_failure = f'{what} failed: {described(error)}'
        self._failure_log.error(
            f'{what} {type(error)}',
            f'{self.last_failure} ({self.failures[what]} so far): please report this',
        )
        return self.last_failure


def described(error: Exception) -> str:
    """Return what kind of error it is, what it says, and where it was raised, in one line."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    text = ' '.join(str(error).split())
    return f'{type(error).__name__}: {text} ({frame.name}, {frame.filename}:{frame.lineno})'


def _refusal(request: Any, response: Any, text: str) -> Any:
    """Return a response that says, as far as its type can, that the request was not done."""
    result = SetParametersResult(successful=False, reason=text)
    fields = {
        'success': False,
        'message': text,
        'result': getattr(response, 'RESULT_INDEFINITE_FAILURE', None),  # of nav2_msgs
        'results': [result for _ in getattr(request, 'parameters', ())],
    }
    if isinstance(getattr(response, 'result', None), SetParametersResult):
        fields['result'] = result
    for name, value in fields.items():
        if value is not None and hasattr(response, name):
            setattr(response, name, value)
    return response


def _do_nothing(*arguments: Any) -> Any:
    """Take the place of a callback whose timer, topic or service has been removed."""
    return arguments[-1] if arguments else None  # a service's response, which nobody hears


class Entities:
    """Remembers the publishers, subscriptions, services, timers and callbacks a node has now.

    A subscription to the clock is none of them: rclpy makes it while ``use_sim_time`` is set.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._known = self._present()

    def remove_new(self) -> None:
        """Destroy what the node has got since; an executor that holds it calls nothing of it."""
        for remove, entities in self._present().items():
            for entity in entities - self._known[remove]:
                if hasattr(entity, 'callback'):
                    entity.callback = _do_nothing
                getattr(self._node, remove)(entity)

    def _present(self) -> dict[str, set[Any]]:
        node = self._node
        return {
            'destroy_timer': set(node.timers),
            'destroy_subscription': {
                each for each in node.subscriptions if each.msg_type is not Clock
            },
            'destroy_service': set(node.services),
            'destroy_publisher': set(node.publishers),
            # rclpy has no public name for these.
            'remove_on_set_parameters_callback': set(node._on_set_parameters_callbacks),
            'remove_post_set_parameters_callback': set(node._post_set_parameters_callbacks),
        }


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


# Makes what the nodes publish.
MESSAGES = OutgoingMessages(message_class, lambda data: array('B', data))
RELIABLE_QOS = QoSProfile(depth=10)  # out: any subscriber fits a reliable publisher

# Out: as AMCL's pose; a late subscriber gets the last ones, as many as it keeps itself.
LATCHED_POSE_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# Out: a subscriber that comes late gets the last message.
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def take(subscription: Subscription) -> tuple[bytes, Mapping[str, int]] | None:
    """Take the next raw message that waits, with what DDS knows of it; None if there is none."""
    with subscription.handle:
        taken: tuple[bytes, Mapping[str, int]] | None = subscription.handle.take_message(
            subscription.msg_type, subscription.raw
        )
    return taken


def with_info(receive: Callable[[bytes, Mapping[str, int]], None]) -> Callable[..., None]:
    """Return a callback for a message with what DDS knows of it: some executors join them."""

    def callback(*taken: Any) -> None:
        receive(*(taken[0] if len(taken) == 1 else taken))

    # By which rclpy sees that the callback wants both.
    callback.__signature__ = signature(receive)  # type: ignore[attr-defined]
    return callback


INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1


class RepeatableParameters(GuardedNode):
    """Takes the value that a parameter has, also of read-only ones, as in a dumped file."""

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

    Names that are set but in no table are ignored with a warning: they may be other nodes'. Raise
    a ParameterError if one is ours, misspelt, and an InvalidParameterValueException if a value
    that is set does not fit its row.
    """
    rows = [row for settings_class in settings_classes for row in table(settings_class)]
    names = [row.name for row in rows]
    # rclpy, unlike rclcpp, has no public name for what the command line and files set.
    written = [
        name
        for name in sorted(node._parameter_overrides)
        if not (node.has_parameter(name) or name.startswith('qos_overrides.'))
    ]
    if ignored := names_of_others(written, names):
        node.get_logger().warning(f'unknown parameters are ignored: {", ".join(ignored)}')
    _warn_of_misplaced(node, names)

    def check(changes: Sequence[RosParameter]) -> SetParametersResult:
        changed = {change.name: change.value for change in changes}
        present = {row: node.get_parameter(row) for row in names if node.has_parameter(row)}
        try:
            for settings_class in settings_classes:
                own = [row.name for row in table(settings_class)]
                values = {name: present[name].value for name in own if name in present}
                values |= {name: changed[name] for name in own if name in changed}
                from_parameters(settings_class, values)
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
    """Return a row's ROS descriptor; it leaves types dynamic, so ``gain:=4`` may set a float."""
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
                f"parameter file {path} has nothing for '{full_name}'; are the values "
                f"under '{sections[0]}' meant for it?"
            )
