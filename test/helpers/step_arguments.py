"""Arguments of the step, at random: of motions and of observations, planar and in space."""

from __future__ import annotations

from any_sizes import up_to
import numpy as np

from slam_observer_ros.filter.flat_arrays import (
    Advanced,
    FilterState,
    Interval,
    Limits,
    Observed,
    Seen,
)
from slam_observer_ros.filter.landmark_table import Landmarks
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.models.held_velocities import Velocities
from slam_observer_ros.models.motion_noise import Factors, MotionFigures
from slam_observer_ros.models.point_noise import PointFigures
from slam_observer_ros.models.velocity_history import NEVER_NS

SECOND_NS = 1_000_000_000
START_NS = 1_700_000_000 * SECOND_NS


def random_covariance(rng, size, scale=0.1):
    M = rng.standard_normal((size, size + 2))
    return scale**2 * M @ M.T / size


def random_estimate(rng, n=None, of_tags=False, is_exact=False):
    is_planar = bool(rng.integers(2))
    p, k = (3, 2) if is_planar else (6, 3)
    velocity_entries = rng.permutation(42)[: up_to(rng, 18)]
    estimated = np.append(velocity_entries, 42).astype(np.int64)
    c = len(estimated) + up_to(rng, 60) - 1  # of up to eight sensors
    n = up_to(rng, 200) if n is None else n
    first = p + c + int(rng.integers(0, 9)) * int(rng.integers(2))  # with what is postponed
    stride = 0 if is_exact else k + of_tags * (p - k)
    size = first + stride * n
    room = size + int(rng.integers(0, 9))
    P = np.zeros((room, room))
    P[:size, :size] = random_covariance(rng, size)
    rates = np.eye(6, 7) + 0.02 * rng.standard_normal((6, 7))
    A = se3.exp(rng.standard_normal(6))
    y_ref, a = 5.0 * rng.standard_normal((n, 3)), 0.1 * rng.standard_normal((n, 3))
    if is_planar:
        A = se3.flatten(A)
        y_ref[:, 2] = a[:, 2] = 0.0
    drift = np.diag(rng.uniform(0.0, 1e-6, c)) * rng.integers(2)
    return FilterState(
        A, y_ref, a, P, size, first, stride, is_planar, rates, estimated, drift, None
    )


def random_motion(rng):
    """Return arguments of ``advance``."""
    n = None if rng.random() < 0.9 else 0
    x = random_estimate(rng, n, rng.random() < 0.3, rng.random() < 0.1)
    r = int(rng.integers(2, 30))
    steps_ns = rng.integers(1_000_000, 100_000_000, r)
    stamps_ns = START_NS + np.cumsum(steps_ns)
    stamps_ns[0] = NEVER_NS
    since_ns = np.column_stack([stamps_ns - rng.integers(0, 10_000_000, r), stamps_ns])
    V = rng.standard_normal((r, 6)) * (rng.random((r, 1)) < 0.9)
    is_stated = (rng.random((r, 2)) < 0.5) & (rng.random() < 0.5)
    stated = np.array([random_covariance(rng, 6, rng.choice([0.1, 100.0])) for _ in range(r)])
    known = np.repeat(is_stated, 3, axis=1)
    stated *= known[:, :, None] & known[:, None, :]
    usual_s = tuple(rng.choice([0.02, 0.1, np.inf], 2).tolist())
    velocities = Velocities(stamps_ns, V, since_ns, is_stated, stated, *usual_s, SECOND_NS)
    begin_ns = int(rng.integers(stamps_ns[1], stamps_ns[-1] + 1))
    end_ns = begin_ns + int(rng.integers(1, 500_000_000)) * int(rng.random() < 0.9)
    delay_ns = int(rng.integers(-50_000_000, 50_000_000))
    at_start = rng.standard_normal(6) if rng.integers(2) else None
    reach_ns = int(rng.choice([0, 200_000_000]))
    interval = Interval(begin_ns, end_ns, delay_ns, reach_ns, at_start)
    scales = rng.uniform(0.0, 0.1, 6) * rng.integers(2)
    figures = MotionFigures(
        rng.uniform(1e-5, 1e-2, 6), scales, rng.uniform(0.5, 2.0, 2), np.ones(6)
    )
    p = 3 if x.is_planar else 6
    out = Advanced(
        np.zeros((4, 4)),
        np.zeros((p, p)),
        np.zeros((p, p)),
        np.zeros((p, len(x.drift))),
        np.zeros(6),
        np.zeros(6),
    )
    return x, velocities, interval, figures, out


def random_observation(rng):
    """Return arguments of ``observe``."""
    x = random_estimate(rng, None, rng.random() < 0.2, rng.random() < 0.2)
    n, p = len(x.a), 3 if x.is_planar else 6
    m = min(n, up_to(rng, 32))  # of more, numpy takes one block after the other
    rows = rng.permutation(n)[:m]
    now_ns = START_NS
    last_ns = now_ns - rng.integers(0, 3, n) * SECOND_NS
    before_ns = np.where(rng.random(n) < 0.3, -1, last_ns - SECOND_NS)
    counts, rejections = rng.integers(1, 9, n), rng.integers(0, 2, n) * rng.integers(0, 2)
    landmarks = Landmarks(counts, rejections, last_ns, before_ns)
    expected = (x.y_ref[rows] + x.a[rows] - x.A[:3, 3]) @ x.A[:3, :3]
    points = expected + 0.1 * rng.standard_normal((m, 3)) * (1.0, 1.0, 1.0 - x.is_planar)
    if rng.random() < 0.3:  # some, or most, are rejected
        points[rng.random(m) < rng.choice([0.1, 0.9]), :2] += 20.0
    rows[rng.random(m) < rng.choice([0.0, 0.0, 0.3, 1.0])] = -1  # some, or all, are new
    origins = 0.2 * rng.standard_normal((m, 3)) if rng.integers(2) else None
    c, c_v = len(x.drift), len(x.estimated)
    c_s = min(len(x.drift) - c_v, int(rng.integers(8)))
    is_calibrated = bool(rng.integers(2))
    turns = rng.standard_normal((m, 3)) * (1.0 - x.is_planar, 1.0 - x.is_planar, 1.0)
    directions = so3.exp(turns)
    unmeasured = rng.random((m, 3)) < 0.4
    directions[unmeasured & ~unmeasured[:, :2].all(axis=1)[:, None]] = 0.0
    seen = Seen(
        now_ns,
        rows,
        points if origins is None else points - origins,
        origins,
        np.array([random_covariance(rng, 3, rng.choice([0.0, 0.1])) for _ in rows])
        if rng.integers(2)
        else None,
        directions if rng.integers(2) else None,
        0.01 * rng.standard_normal(7) if is_calibrated else None,
        np.sort(rng.permutation(7)[:c_s]).astype(np.int64),
        c_v,
        None if is_calibrated or rng.integers(2) else 0.1 * rng.standard_normal((m, 3, c)),
    )
    huber, error_time_s = float(rng.choice([0.0, 1.345])), float(rng.choice([0.0, 0.5]))
    limits = Limits(6.0, huber, error_time_s, 3, 4, int(rng.integers(2)))
    factors = None
    if rng.integers(2):
        shares = np.array([random_covariance(rng, p, 0.02) for _ in range(2)])
        logs, information = rng.standard_normal(2), random_covariance(rng, 2, 1.0)
        factors = Factors(shares, logs, information, np.exp(np.maximum(logs, 0.0)), 0.0)
    out = Observed(
        np.zeros((4, 4)),
        *(np.zeros((m, 3)), np.zeros((m, 3)), np.zeros(m), np.zeros((m, 3)), np.zeros((m, 3))),
        np.zeros((0 if seen.covariances is None else m, 3, 3)),
        np.zeros(m),
        np.zeros(x.size),
        np.zeros(int(rng.choice([0, 3 * m + 1]))),
    )
    figures = PointFigures(*rng.uniform(1e-4, 1e-2, 5).tolist())
    assert x.size == x.first + x.stride * n
    return x, landmarks, seen, figures, limits, factors, out


def wrong(rng, arguments):
    """Return the arguments with one of them, or a part of one, exchanged for something else."""
    arguments = list(arguments)
    at = int(rng.integers(len(arguments)))
    if not isinstance(arguments[at], tuple):
        arguments[at] = 3 if arguments[at] is None else other_than(rng, arguments[at])
        return arguments
    parts = list(arguments[at])
    part = int(rng.integers(len(parts)))
    parts[part] = other_than(rng, parts[part])
    arguments[at] = tuple(parts)
    return arguments


def other_than(rng, value):
    """Return what a value is not."""
    others = [None, 'x', -1, 2**62, -(2**62), 10**30, float('nan'), np.empty(0), (), b'']
    if isinstance(value, np.ndarray):
        with np.errstate(over='ignore'):
            single = value.astype(np.float32)
        others += [
            value[..., None],
            value[:-1] if value.ndim else value,
            single,
            np.asfortranarray(np.repeat(value, 2, axis=-1))[..., ::2] if value.ndim else value,
            np.full(value.shape, 2**62, dtype=np.int64),
            np.full(value.shape, np.nan),
            np.full(value.shape, 1e300),
            np.zeros_like(value),
        ]
    return others[int(rng.integers(len(others)))]


def refusals(rng, calls):
    """Make calls, each with its arguments and with wrong ones; count those that are refused."""
    refused = 0
    for call, arguments in calls:
        call(*arguments)
        try:
            call(*wrong(rng, arguments))
        except (ValueError, TypeError, BufferError, OverflowError):
            refused += 1
    return refused


def fuzz(core, seed, rounds):
    """Call both functions with arguments that are right and with wrong ones; count refusals."""
    rng, refused = np.random.default_rng(seed), 0
    for _ in range(rounds):
        calls = (core.advance, random_motion(rng)), (core.observe, random_observation(rng))
        refused += refusals(rng, calls)
    return refused
