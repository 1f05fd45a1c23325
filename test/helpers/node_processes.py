"""Real node processes, and a ROS node of the test's own that talks with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import gc
import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from typing import Any, ClassVar

from rcl_interfaces.srv import GetParameterTypes
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from slam_observer_ros.nodes.runner import _reason, REFUSALS

PATIENCE_S = 30.0
"""How long anything may take before a test fails; it normally takes a fraction of a second."""

ASK_AGAIN_S = 0.5
"""After which time an answer that was given to nobody is asked for again."""

RELIABLE = QoSProfile(depth=5000)

OBSERVERS = {'observer_node', 'lifecycle_observer_node'}

ALL_ARE_USED = {'landmarks_max_wait': 60.0}
"""Else an observer drops old landmarks when the tests have a busy machine, as it should."""


class Forks:
    """The program that forks for nodes, and how it is asked."""

    def __init__(self) -> None:
        self._program: subprocess.Popen[str] | None = None

    def ask(self, **question: object) -> int | None:
        if self._program is None:
            self._program = subprocess.Popen(
                [sys.executable, Path(__file__).with_name('node_forks.py')],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
            )  # fmt: skip
        self._program.stdin.write(f'{json.dumps(question)}\n')
        answer: int | None = json.loads(self._program.stdout.readline())
        return answer

    def end(self) -> None:
        """End the program, whose nodes have ended."""
        if self._program is not None:
            self._program.communicate(timeout=PATIENCE_S)
            self._program = None


FORKS = Forks()


class Fork:
    """A node that was forked; what `subprocess.Popen` does, as far as tests need it."""

    def __init__(self, name: str, log: Path, arguments: list[str]) -> None:
        environment = dict(os.environ)
        self.returncode: int | None = None
        self.pid = FORKS.ask(name=name, log=str(log), arguments=arguments, environment=environment)

    def poll(self) -> int | None:
        if self.returncode is None:
            self.returncode = FORKS.ask(process=self.pid)
        return self.returncode

    def wait(self, timeout: float = PATIENCE_S) -> int:
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            assert time.monotonic() < deadline, 'the node does not end'
            time.sleep(0.01)
        return code

    def send_signal(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class NodeProcess:
    """A node as a process, with its output in a file."""

    started: ClassVar[int] = 0

    def __init__(
        self,
        name: str,
        log: Path,
        *arguments: str,
        program: Path | None = None,
        is_forked: bool = False,
        **parameters: object,
    ) -> None:
        """Start a node, or a program of its own in its place, or fork one that is loaded."""
        self.log = log
        always = ALL_ARE_USED if name in OBSERVERS else {}
        arguments = '--ros-args', *_options(always | parameters), *arguments
        NodeProcess.started += 1
        if is_forked:
            log.touch()
            self.process = Fork(name, log, arguments)
            return
        module = ['-m', 'slam_observer_ros.nodes.executables', name]
        command = [sys.executable, *(module if program is None else [str(program)])]
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
        self._ask_again_s = 0.0

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
            topic = publisher.topic_name
            self.spin_until(publisher.get_subscription_count, f'reader of {topic}')
            self._meet_all(topic, self.node.get_subscriptions_info_by_topic)

    def wait_for_publisher(self, *topics: str) -> None:
        """Wait until each topic has a publisher that knows of this node's subscriptions."""
        for topic in topics:
            self._meet_all(topic, self.node.get_publishers_info_by_topic)

    def call(self, service_class: type, name: str, request: Any) -> Any:
        """Call a service ``NODE/NAME`` and return its response."""
        # A node that was started since may have taken the place of the one that was called.
        key = service_class, name, NodeProcess.started
        if key not in self._clients:
            self._clients[key] = self.node.create_client(service_class, name)
            self.spin_until(self._clients[key].service_is_ready, name)
            # Of a client that the server had not heard of, the response would be lost.
            self.meet(name.rpartition('/')[0])
        future = self._clients[key].call_async(request)
        self.spin_until(future.done, f'response of {name}')
        return future.result()

    def meet(self, node_name: str) -> None:
        """Wait until a node knows all that was made here, and has handled what it was sent.

        What is made is announced in order, so a node that answers a new client knows all before.
        """
        asked = self.node.create_client(GetParameterTypes, f'{node_name}/get_parameter_types')
        self.spin_until(asked.service_is_ready, node_name)
        answers: list[Any] = []

        def is_answered() -> bool:
            if not answers or time.monotonic() > self._ask_again_s:
                answers.append(asked.call_async(GetParameterTypes.Request()))
                self._ask_again_s = time.monotonic() + ASK_AGAIN_S
            return any(answer.done() for answer in answers)

        self.spin_until(is_answered, f'an answer of {node_name}')
        self.node.destroy_client(asked)

    def _meet_all(self, topic: str, ends: Callable[[str], list[Any]]) -> None:
        """Meet the nodes that have one end of a topic."""
        self.spin_until(
            lambda: ends(topic) and all('UNKNOWN' not in end.node_name for end in ends(topic)),
            topic,
        )
        for node_name in {
            f'{end.node_namespace.rstrip("/")}/{end.node_name}' for end in ends(topic)
        }:
            self.meet(node_name)

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
    node = NodeProcess(name, log, *arguments, is_forked=True, **parameters)
    try:
        yield node
        assert node.stop() == 0, node.output
        assert 'Traceback' not in node.output, node.output
        assert 'number of timers' not in node.output, 'EventsExecutor finds there are too many'
    finally:
        node.process.kill()
        node.process.wait()


def reason_of_refusal(make_node: Callable[[], Node], *arguments: str, **parameters: object) -> str:
    """Make a node of this process, which refuses what it is given; return its reason.

    A process would end with the exit code 2 and this as its last line.
    """
    rclpy.init(
        args=['--ros-args', *_options(parameters), *arguments],
        signal_handler_options=SignalHandlerOptions.NO,
    )
    reason = None
    try:
        make_node()
    except REFUSALS as error:
        reason = _reason(error)
    gc.collect()  # what was made of the node, as long as there is ROS
    rclpy.shutdown()
    assert reason is not None, 'the node has not refused it'
    return reason


def _options(parameters: dict[str, object]) -> list[str]:
    return [word for key, value in parameters.items() for word in ('-p', f'{key}:={_yaml(value)}')]


def _yaml(value: object) -> str:
    return json.dumps(value) if value == '' or isinstance(value, bool | tuple) else str(value)
