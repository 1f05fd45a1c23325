"""A node that nothing ends which comes in: what a callback raises is logged, and it goes on.

And what else nodes log: lines that would be repeated, and lines of the layers without ROS.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import wraps
import logging
import time
import traceback
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock as SteadyClock
from rclpy.clock import ClockType
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock

from slam_observer_ros.common.findings import Finding, found

REPORT_PERIOD_S = 10.0
"""Shortest time between two lines about one subject."""


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
        is_due = self._is_due(subject)
        if is_due:
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
    """A node whose callbacks may fail: rclpy would end the process.

    Attributes
    ----------
    failures : Counter
        How often callbacks have failed, by what they were called for.
    last_failure : str
        What the last one has raised, and where; empty before the first.

    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.failures: Counter[str] = Counter()
        self.last_failure = ''
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

    A subscription to the clock is none of them: rclpy itself makes it whenever ``use_sim_time`` is
    set, and needs it for as long.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._known = self._present()

    def remove_new(self) -> None:
        """Destroy what the node has got since; nothing of it is called any more.

        An executor may have heard already that something is due, and calls it all the same.
        """
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
