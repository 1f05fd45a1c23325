"""Nodes start and stop as a launch system expects: exit code 0, no traceback."""

from __future__ import annotations

import signal

from node_processes import NodeProcess
import pytest

pytestmark = pytest.mark.ros

STOPS = {
    'interrupt': (signal.SIGINT,),
    'terminate': (signal.SIGTERM,),
    'interrupt twice': (signal.SIGINT, signal.SIGINT),
    'interrupt and terminate': (signal.SIGINT, signal.SIGTERM, signal.SIGINT),
}
READY = {'observer_node': 'estimating', 'simulator_node': 'waiting|starts'}


@pytest.fixture(scope='module')
def processes(tmp_path_factory):
    folder = tmp_path_factory.mktemp('logs')
    started = {
        (name, stop): NodeProcess(name, folder / f'{name} {stop}.log')
        for name in READY
        for stop in STOPS
    }
    yield started
    for node in started.values():
        node.process.kill()
        node.process.wait()


@pytest.mark.parametrize('stop', STOPS)
@pytest.mark.parametrize('name', READY)
def test_signals_stop_a_node_cleanly(processes, name, stop):
    node = processes[name, stop]
    node.wait_for_output(READY[name])

    code = node.stop(*STOPS[stop])

    assert code == 0, node.output
    assert 'Traceback' not in node.output
