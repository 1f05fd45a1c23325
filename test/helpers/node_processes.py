"""Real node processes, and a ROS node of the test's own that talks with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from typing import Any, ClassVar

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile

PATIENCE_S = 30.0
"""How long anything may take before a test fails; it normally takes a fraction of a second."""

RELIABLE = QoSProfile(depth=5000)

OBSERVERS = {'observer_node', 'lifecycle_observer_node'}

ALL_ARE_USED = {'landmarks_max_wait': 60.0}
"""Else an observer drops old landmarks when the tests have a busy machine, as it should."""


class NodeProcess:
    """A node as a child process, with its output in a file."""

    started: ClassVar[int] = 0

    def __init__(
        self,
        name: str,
        log: Path,
        *arguments: str,
        program: Path | None = None,
        **parameters: object,
    ) -> None:
        """Start a node, or a program of its own in its place."""
        self.log = log
        module = ['-m', f'slam_observer_ros.nodes.{name}']
        command = [sys.executable, *(module if program is None else [str(program)]), '--ros-args']
        always = ALL_ARE_USED if name in OBSERVERS else {}
        for key, value in (always | parameters).items():
            command += ['-p', f'{key}:={_yaml(value)}']
        NodeProcess.started += 1
        with log.open('w') as output:
            self.process = subprocess.Popen(
                [*command, *arguments], stdout=output, stderr=subprocess.STDOUT
            )

    @property
    def output(self) -> str:
        return self.log.read_text()

    def wait_for_output(self, pattern: str) -> None:
        """Wait until a line matches; the node may write it at any time."""
        deadline = time.monotonic() + PATIENCE_S
        while not re.search(pattern, self.output):
            assert self.process.poll() is None, f'the node has ended:\n{self.output}'
            assert time.monotonic() < deadline, f'no {pattern!r} in:\n{self.output}'
            time.sleep(0.05)

    def wait_for_library(self, name: str) -> None:
        """Wait until the process, which is just starting, has loaded a shared library."""
        deadline = time.monotonic() + PATIENCE_S
        while name not in Path(f'/proc/{self.process.pid}/maps').read_text():
            assert self.process.poll() is None, f'the node has ended:\n{self.output}'
            assert time.monotonic() < deadline, f'{name} is not loaded'
            time.sleep(0.002)

    def wait(self) -> int:
        return self.process.wait(timeout=PATIENCE_S)

    def stop(self, *signals: signal.Signals) -> int:
        """Send signals right after one another; return the exit code."""
        for number in signals or (signal.SIGINT,):
            self.process.send_signal(number)
        return self.wait()


class Client:
    """The test's own node."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('test_client', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._clients: dict[tuple[type, str, int], Any] = {}

    def collect(self, message_class: type, topic: str, qos: QoSProfile = RELIABLE) -> list[Any]:
        """Return a list to which every message on the topic will be appended."""
        messages: list[Any] = []
        self.node.create_subscription(message_class, topic, messages.append, qos)
        return messages

    def spin_until(self, condition: Callable[[], object], what: str = 'condition') -> None:
        """Handle messages until the condition holds."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f'waited in vain for {what}'
            self._executor.spin_once(timeout_sec=0.02)

    def spin_for(self, duration_s: float) -> None:
        """Handle messages for a while."""
        end = time.monotonic() + duration_s
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def wait_for_subscriber(self, *publishers: Any) -> None:
        """Wait until each publisher has a subscriber that can hear it."""
        for publisher in publishers:
            self.spin_until(publisher.get_subscription_count, f'reader of {publisher.topic_name}')
        # The publisher hears of its reader first; the other way takes a moment longer.
        self.spin_for(0.5)

    def wait_for_publisher(self, *topics: str) -> None:
        """Wait until each topic has a publisher."""
        for topic in topics:
            self.spin_until(
                lambda topic=topic: self.node.get_publishers_info_by_topic(topic), topic
            )

    def call(self, service_class: type, name: str, request: Any) -> Any:
        """Call a service and return its response."""
        # A node that was started since may have taken the place of the one that was called.
        key = service_class, name, NodeProcess.started
        if key not in self._clients:
            self._clients[key] = self.node.create_client(service_class, name)
            self.spin_until(self._clients[key].service_is_ready, name)
            # The server may not have heard of its client yet; its response would then be lost.
            self.spin_for(0.5)
        future = self._clients[key].call_async(request)
        self.spin_until(future.done, f'response of {name}')
        return future.result()

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@contextmanager
def client() -> Iterator[Client]:
    """Give a client and close it."""
    opened = Client()
    try:
        yield opened
    finally:
        opened.close()


@contextmanager
def running(name: str, log: Path, *arguments: str, **parameters: object) -> Iterator[NodeProcess]:
    """Run a node; at the end stop it and check that it ended cleanly."""
    node = NodeProcess(name, log, *arguments, **parameters)
    try:
        yield node
        assert node.stop() == 0, node.output
        assert 'Traceback' not in node.output, node.output
        assert 'number of timers' not in node.output, 'EventsExecutor finds there are too many'
    finally:
        node.process.kill()
        node.process.wait()


def _yaml(value: object) -> str:
    return json.dumps(value) if value == '' or isinstance(value, bool | tuple) else str(value)
