"""Each point that is observed is used, or there is exactly one reason why it is not."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import settings as hypothesis_settings
import numpy as np
import pytest
from strategies import generators

from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.estimates import Change, Reason, used_points
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import IMPOSSIBLE_ID, ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

LANDMARKS = 12
SETTINGS = Settings(reorder_window=0.0, two_d_mode=True, observation_model='cartesian')
VELOCITY = np.array([0.0, 0.0, 0.3, 0.5, 0.0, 0.0])


def events(rng, seconds=6):
    """A drive whose sensor errs in all ways: ids repeated, wrong, impossible or none, and NaN."""
    world = np.column_stack([rng.uniform(-6.0, 6.0, (LANDMARKS, 2)), np.zeros(LANDMARKS)])
    A = np.eye(4)
    for k in range(10 * seconds):
        yield VelocityEvent(k * 10**8, VELOCITY)
        A = A @ se3.exp(0.1 * VELOCITY)
        ids = rng.permutation(LANDMARKS)[: rng.integers(1, LANDMARKS)].astype(np.int64)
        points = se3.transform(se3.inverse(A), world[ids]) + 0.02 * rng.normal(size=(len(ids), 3))
        odd = rng.random(len(ids))
        points[odd < 0.1] += rng.normal(0.0, 4.0, 3)
        covariances = np.tile(4e-4 * np.eye(3), (len(ids), 1, 1))
        covariances[(odd > 0.1) & (odd < 0.13)] = np.nan
        for k_th, wrong in enumerate((IMPOSSIBLE_ID, UNKNOWN_ID, FIRST_AUTOMATIC_ID, int(ids[0]))):
            ids[(odd > 0.8 + 0.04 * k_th) & (odd < 0.84 + 0.04 * k_th)] = wrong
        yield ObservationEvent((k + 1) * 10**8 - 1, ids, points, covariances)


@pytest.mark.parametrize(
    'change',
    [{}, {'gains': 'constant'}, {'max_landmarks': 5}, {'max_points': 6}, {'max_hypotheses': 1}],
    ids=str,
)
@hypothesis_settings(max_examples=4)
@given(rng=generators())
def test_each_observed_point_is_used_or_has_exactly_one_reason(change, rng):
    updates = []
    settings = replace(SETTINGS, **change)
    estimator = Estimator(settings, on_update=updates.append, keeps_outcomes=True)
    every = []
    for event in events(rng):
        before, updated = used_points(estimator.counts), len(updates)
        estimator.add(event)
        if len(updates) == updated:
            continue
        so_far, every = every, estimator.outcomes
        if every[: len(so_far)] != so_far:
            continue  # another hypothesis is the most likely now, with a history of its own
        each = every[len(so_far) :]
        reasons = [one for one in each if isinstance(one.what, Reason)]
        found = sum(one.what is Change.FOUND for one in each)
        used = int(np.sum(~updates[-1].rejected)) + found
        assert used + len(reasons) == len(event.ids)
        assert used_points(estimator.counts) - before == used
        named = [one.landmark_id for one in reasons if 0 <= one.landmark_id < LANDMARKS]
        allowed = [i for i in event.ids.tolist() if 0 <= i < LANDMARKS]
        assert all(named.count(i) <= allowed.count(i) for i in named)


def test_nothing_is_kept_unless_it_is_asked_for():
    estimator = Estimator(SETTINGS)
    for event in events(np.random.default_rng(0)):
        estimator.add(event)
    assert estimator.counts[Reason.REPEATED_ID.value]
    assert estimator.outcomes == []
