"""Saving a map: quick, over regular files only, and what was there is never lost on the way."""

from __future__ import annotations

from contextlib import contextmanager
import os
import resource
import time
from unittest.mock import Mock

import numpy as np
import pytest
from std_srvs.srv import Trigger

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.nodes.services import END_S, MapServices
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

pytestmark = pytest.mark.ros


class Saving:
    """Services of an observer that has confirmed ``n`` landmarks."""

    def __init__(self, path, n=4):
        self.path = path
        self.node = Mock()
        self.node.get_parameter.return_value.value = str(path)
        estimator = Estimator(Settings(reorder_window=0.0))
        points = np.random.default_rng(1).normal(size=(n, 3))
        for stamp_ns in range(0, 500_000_000, 100_000_000):
            estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
            estimator.add(ObservationEvent(stamp_ns, np.arange(n), points))
        MapServices(self.node, ObserverNodeSettings(map_path=str(path)), estimator, Mock())
        self._callbacks = {
            call.args[1]: call.args[2] for call in self.node.create_service.call_args_list
        }

    def call(self, service):
        return self._callbacks[f'~/{service}'](None, Trigger.Response())


@contextmanager
def full_disk(free_bytes):
    """Let no file grow beyond a few bytes, as on a disk that is nearly full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_on_a_full_disk_all_is_left_as_it_was_however_often_it_is_tried(tmp_path):
    path = tmp_path / 'hall.yaml'
    path.write_text('surveyed' * 1000)
    (tmp_path / 'hall.yaml~').write_text('older')
    saving = Saving(path)
    for _ in range(3):
        with full_disk(1000):
            answer = saving.call('save_map')
        assert not answer.success
        assert answer.message == f"can't write map {path}: File too large"
    assert path.read_text() == 'surveyed' * 1000
    assert (tmp_path / 'hall.yaml~').read_text() == 'older'
    assert names(tmp_path) == ['hall.yaml', 'hall.yaml~']


def test_what_a_file_held_is_in_one_copy_beside_it(tmp_path):
    path = tmp_path / 'hall.yaml'
    path.write_text('surveyed')
    path.chmod(0o640)
    saving = Saving(path)
    assert saving.call('save_map').message.endswith('; what it held before is in hall.yaml~')
    assert saving.call('save_map').message.endswith('hall.yaml')
    assert (tmp_path / 'hall.yaml~').read_text() == 'surveyed'
    assert (tmp_path / 'hall.yaml~').stat().st_mode & 0o777 == 0o640
    assert len(read_map(path).ids) == 4
    Saving(path).call('save_map')
    assert len(read_map(tmp_path / 'hall.yaml~').ids) == 4
    assert names(tmp_path) == ['hall.yaml', 'hall.yaml~']


def test_a_copy_is_not_written_where_a_link_of_its_name_leads(tmp_path):
    path, victim = tmp_path / 'hall.yaml', tmp_path / 'victim'
    path.write_text('surveyed')
    victim.write_text('precious')
    (tmp_path / 'hall.yaml~').symlink_to(victim)
    assert Saving(path).call('save_map').success
    assert victim.read_text() == 'precious'
    assert (tmp_path / 'hall.yaml~').read_text() == 'surveyed'


@pytest.mark.timeout(20)
@pytest.mark.parametrize('service', ['save_map', 'load_map'])
@pytest.mark.parametrize('name', ['pipe', '/dev/full'])
def test_what_is_no_regular_file_is_refused_at_once_in_a_line(tmp_path, service, name):
    path = tmp_path / name
    if name == 'pipe':
        os.mkfifo(path)
    before = names(path.parent)
    answer = Saving(path).call(service)
    assert not answer.success
    assert answer.message in (
        f"can't write map {path}: it is there, and no regular file",
        f"can't read map {path}: it is no regular file",
    )
    assert names(path.parent) == before


def test_at_the_end_what_is_held_back_is_used_only_as_far_as_that_is_quick(tmp_path):
    path = tmp_path / 'hall.yaml'
    used = []

    def take_long(update):
        used.append(update.stamp_ns)
        time.sleep(2.0 * END_S)

    estimator = Estimator(Settings(reorder_window=10.0, confirmations=1), on_update=take_long)
    for stamp_ns in range(100_000_000, 600_000_000, 100_000_000):
        estimator.add(ObservationEvent(stamp_ns, np.arange(4), np.eye(4, 3)))
    settings = ObserverNodeSettings(map_path=str(path), autosave_map=True)
    node = Mock()
    node.get_parameter.return_value.value = str(path)
    MapServices(node, settings, estimator, Mock()).save_at_end()
    assert len(used) == 1
    assert len(read_map(path).ids) == 4


def test_nothing_is_computed_of_landmarks_that_are_not_confirmed(tmp_path, monkeypatch):
    sizes = []
    estimator = Estimator(Settings(reorder_window=0.0))
    points = np.random.default_rng(1).normal(size=(50, 3))
    for stamp_ns in range(0, 500_000_000, 100_000_000):
        seen = np.arange(50 if stamp_ns == 0 else 4)
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        estimator.add(ObservationEvent(stamp_ns, seen, points[seen]))
    for name in ('eigh', 'cholesky'):
        compute = getattr(np.linalg, name)
        monkeypatch.setattr(
            np.linalg, name, lambda P, compute=compute: sizes.append(P.shape[-1]) or compute(P)
        )
    assert estimator.landmark_map.ids.tolist() == [0, 1, 2, 3]
    assert max(sizes) <= 12
