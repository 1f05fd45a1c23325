"""Velocities that come as blocks: what they give is what they give one by one."""

from __future__ import annotations

from itertools import groupby

from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from strategies import generators

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    ObservationEvent,
    VelocityBlock,
    VelocityEvent,
)
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

START_NS = 1_700_000_000_000_000_000
POINTS = np.array([[4.0, 0, 0], [-4, 0, 1], [0, 4, 0.5], [1, -4, 0], [2, 2, 2]])
TWIST = np.array([0.02, 0.0, 0.3, 0.8, 0.1, 0.0])
STEPS_S = (0.02, 0.02, 0.021, 0.0, -0.03, 0.4, 1.7, 30.0)
USUAL = np.array([0.5, 0.3, 0.1, 0.02, 0.02, 0.03, 0.02, 0.01])
"""Steps of stamps, and how often they are taken: duplicates, disorder, gaps, jumps."""


def stream(rng, count, disorder, has_imu, has_covariances):
    """Events as they are received, some of them late, twice, far off or not to be used at all."""
    events, at_s = [], 0.0
    weights = np.where(np.arange(8) < 3, USUAL, disorder * USUAL)
    for _ in range(count):
        at_s = max(at_s + rng.choice(STEPS_S, p=weights / weights.sum()), 0.0)
        stamp_ns, received_ns = START_NS + round(at_s * 1e9), START_NS + round(at_s * 1e9) + 10**6
        events.append(velocity(rng, stamp_ns, received_ns, disorder, has_covariances))
        if has_imu and rng.random() < 0.1:
            events.append(AngularVelocityEvent(stamp_ns, rng.normal(size=3), None, received_ns))
        if rng.random() < 0.05:
            events.append(observation(rng, at_s - disorder * rng.choice([0.0, 0.15]), received_ns))
    return events


def velocity(rng, stamp_ns, received_ns, disorder, has_covariances):
    twist = TWIST + 0.05 * rng.normal(size=6)
    if disorder and rng.random() < 0.01:
        twist[rng.integers(6)] = rng.choice([np.nan, 1e4, 1e300])
    covariance = None
    if has_covariances and rng.random() < 0.95:
        covariance = np.diag(rng.uniform(0.0, 0.1, size=6)) * (rng.random(6) < 0.9)
        if disorder and rng.random() < 0.02:
            covariance[0, 1] = 1.0
    return VelocityEvent(stamp_ns, twist, covariance, received_ns)


def observation(rng, at_s, received_ns):
    """Landmarks, or none of them, as an idle sensor sees."""
    rows = np.sort(rng.permutation(len(POINTS))[: rng.integers(0, 4)])
    seen = se3.transform(se3.inverse(se3.exp(at_s % 20.0 * TWIST)), POINTS[rows])
    seen = seen + 0.02 * rng.normal(size=seen.shape)
    return ObservationEvent(
        max(START_NS + round(at_s * 1e9), 0), rows, seen, receive_ns=received_ns
    )


def kind_of(event):
    """What a block has of one kind: velocities with covariances, or without."""
    is_velocity = isinstance(event, VelocityEvent)
    return is_velocity, is_velocity and event.covariance is not None


def in_blocks(rng, events):
    """Split runs of velocities into blocks of any length."""
    for (is_velocity, has_covariance), together in groupby(events, key=kind_of):
        left = list(together)
        while left and is_velocity:
            length = int(rng.choice([1, 3, 20, 300]))
            some, left = left[:length], left[length:]
            yield VelocityBlock(
                np.array([event.stamp_ns for event in some]),
                np.array([event.body_velocity for event in some]),
                np.array([event.covariance for event in some]) if has_covariance else None,
                np.array([event.receive_ns for event in some]),
            )
        yield from left


class Observed:
    """All that a run tells of itself."""

    def __init__(self, items, settings):
        self.stamps_ns, self.poses, self.covariances, self.updates = [], [], [], []
        self.estimator = Estimator(settings, on_stamps=self.note, on_update=self.updates.append)
        accepted = 0
        for item in items:
            if isinstance(item, VelocityBlock):
                accepted += self.estimator.add_velocities(item)
            else:
                accepted += self.estimator.add(item)
        self.estimator.flush()
        self.accepted = accepted

    def note(self, stamps_ns):
        self.stamps_ns += stamps_ns.tolist()
        poses, covariances = self.estimator.poses_at(stamps_ns)
        self.poses += list(poses)
        self.covariances += [] if covariances is None else list(covariances)


def assert_equal_bits(one, other):
    a, b = one.estimator, other.estimator
    assert one.accepted == other.accepted
    assert a.counts == b.counts
    assert a.dropped == b.dropped
    assert a.jumps == b.jumps
    assert (a.stamp_ns, a.newest_stamp_ns) == (b.stamp_ns, b.newest_stamp_ns)
    for name in ('pose', 'pose_covariance', 'world_points', 'landmark_covariances'):
        assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for name in ('landmark_ids', 'body_velocity', 'body_velocity_covariance'):
        assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert [update.stamp_ns for update in one.updates] == [u.stamp_ns for u in other.updates]
    for update, same in zip(one.updates, other.updates, strict=True):
        assert_array_equal(update.pose, same.pose)
        assert_array_equal(update.residuals, same.residuals)


def assert_same_samples(one, other):
    """The same at each stamp, but for the rounding of sums in another order."""
    assert one.stamps_ns == other.stamps_ns
    assert_allclose(one.poses, other.poses, rtol=0.0, atol=1e-12)
    assert len(one.covariances) == len(other.covariances)
    for covariance, same in zip(one.covariances, other.covariances, strict=True):
        assert_allclose(covariance, same, rtol=0.0, atol=1e-12 * np.abs(same).max())


@given(
    rng=generators(),
    disorder=st.sampled_from([0.0, 0.0, 0.1, 1.0]),
    has_imu=st.sampled_from([False, False, True]),
    has_covariances=st.booleans(),
    gains=st.sampled_from(['riccati', 'riccati', 'constant']),
    changes=st.fixed_dictionaries(
        {},
        optional={
            'reorder_window': st.sampled_from([0.0, 0.5]),
            'two_d_mode': st.just(True),
            'velocity_delay_stddev': st.sampled_from([0.05, 0.3]),
            'linear_scale_noise': st.just((0.1, 0.1, 0.1)),
            'linear_scale_stddev': st.just((0.02, 0.0, 0.0)),
            'on_time_jump': st.just('hold'),
            'max_linear_velocity': st.just(1.0),
        },
    ),
)
@hypothesis_settings(max_examples=10)
def test_blocks_are_the_events_one_by_one(rng, disorder, has_imu, has_covariances, gains, changes):
    settings = Settings(gains=gains, confirmations=1, **changes)
    events = stream(rng, 250, disorder, has_imu, has_covariances)
    one_by_one, blocks = Observed(events, settings), Observed(in_blocks(rng, events), settings)
    assert_equal_bits(one_by_one, blocks)
    assert_same_samples(one_by_one, blocks)


@pytest.mark.parametrize('first_ns', [START_NS, START_NS + 10**9])
def test_a_velocity_that_is_known_is_not_taken_again_with_others(first_ns):
    """One far ahead waits for others; then they come, and it is among them."""
    stamps_ns = first_ns + 20_000_000 * np.arange(100)
    block = VelocityBlock(stamps_ns, np.tile(TWIST, (100, 1)))
    ahead = VelocityEvent(int(stamps_ns[80]), np.zeros(6))
    start = VelocityEvent(START_NS - 20_000_000, TWIST)
    items = [start, ahead]
    one_by_one = Observed([*items, *block.events()], Settings())
    blocks = Observed([*items, block], Settings())
    assert one_by_one.estimator.dropped['duplicate'] == 1
    assert_equal_bits(one_by_one, blocks)
    assert_same_samples(one_by_one, blocks)
