"""Arguments of the compiled Gauss-Newton, at random: of maps in the plane and in space."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

from any_sizes import up_to
import numpy as np
from smoothing_problems import LANDMARKS, Problem
from step_arguments import refusals

from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.lie.sensor_mounting import Sensed
from slam_observer_ros.smoothing import bordered_chain
from slam_observer_ros.smoothing.bordered_chain import Equations
from slam_observer_ros.smoothing.gauss_newton import Smoother
from slam_observer_ros.smoothing.observations import SensedPoints

D, C, K = 3, 2, 2
SEEN = 4


def random_equations(S, landmarks):
    """Return equations and their dense matrix and gradient, poses first."""
    rng, b = np.random.default_rng(S), C + K * landmarks
    poses = np.repeat(np.arange(S), SEEN)
    seen_landmarks = (poses + rng.integers(0, landmarks, len(poses))) % landmarks
    measured = []

    def measure(rows, *columns):
        J = np.zeros((rows, S * D + b))
        places = np.concatenate(columns)
        J[:, places] = rng.normal(size=(rows, len(places)))
        measured.append(J)

    border = S * D + np.arange(b)
    measure(D + b, np.arange(D), border)
    for s in range(S - 1):
        measure(D, np.arange(s * D, (s + 2) * D), border[:C])
    for s, i in zip(poses, seen_landmarks, strict=True):
        measure(K, np.arange(s * D, (s + 1) * D), border[C + K * i :][:K])
    A = np.concatenate(measured)
    H, g = A.T @ A, A.T @ rng.normal(size=len(A))
    blocks = H[: S * D, : S * D].reshape(S, D, S, D)
    B = H[: S * D, S * D :].reshape(S, D, b)
    first = B[0].copy()
    first[:, :C] = 0.0
    seen = np.array(
        [B[s][:, C + K * i :][:, :K] for s, i in zip(poses, seen_landmarks, strict=True)]
    )
    # One block holds all that a pose has to do with a landmark, however often it was seen.
    _, once = np.unique(poses * landmarks + seen_landmarks, return_index=True)
    once = once[poses[once] > 0]
    every = np.arange(S)
    return (
        Equations(
            diagonal=blocks[every, :, every],
            above=blocks[every[:-1], :, every[1:]],
            shared=B[:, :, :C].copy(),
            poses=poses[once],
            landmarks=seen_landmarks[once],
            seen=seen[once],
            first=first,
            corner=H[S * D :, S * D :].copy(),
            gradient=g[: S * D].reshape(S, D),
            border_gradient=g[S * D :].copy(),
        ),
        H,
        g,
    )


def any_equations(rng):
    """Return equations of any size: of poses with a drifting calibration and many sensors, too."""
    k = int(rng.integers(2, 4))
    d, c = (3, 6)[k - 2] + up_to(rng, 19) - 1, up_to(rng, 63) - 1
    S, n, M = up_to(rng, 500), up_to(rng, 200), up_to(rng, 400)
    poses, landmarks = np.divmod(np.sort(rng.integers(0, S * n, M)), n)  # some more than once
    b = c + k * n

    def linked(*shape):
        return rng.normal(scale=0.1 / np.sqrt(d), size=shape)

    return Equations(
        diagonal=np.tile(10.0 * np.eye(d), (S, 1, 1)),
        above=linked(S - 1, d, d),
        shared=linked(S, d, c),
        poses=poses,
        landmarks=landmarks,
        seen=linked(M, d, k),
        first=linked(d, b),
        corner=10.0 * (1.0 + S) * np.eye(b),
        gradient=linked(S, d),
        border_gradient=linked(b),
    )


def random_smoother(rng):
    """Return a smoother of points, of calibrated sensors or others, and where to linearise."""
    axes, c = (PLANAR, SPATIAL)[rng.integers(2)], up_to(rng, 63) - 1
    known = int(rng.integers(0, LANDMARKS + 1))
    problem = Problem(axes, c, int(rng.integers(2**31)), bool(rng.integers(2)), known)
    huber, gate = rng.choice([0.0, 1.345]), rng.choice([2.0, 1e9])
    settings = replace(problem.settings, huber_threshold=huber, rejection_threshold=gate)
    sensed = random_sensed(rng, problem.keyframes.points, c) if rng.integers(2) else None
    smoother = Smoother(problem.axes, problem.prior, problem.keyframes, settings, sensed)
    start = replace(problem.start, calibrations=problem.start.calibrations + 0.1)
    return smoother, start


def random_sensed(rng, points, c):
    """Return points (M, 3) of two sensors, of which the last of c entries are estimated."""
    M, count = len(points), int(rng.integers(0, min(c, 16) + 1))
    columns = np.full((2, 8), -1)
    places = rng.permutation(16)[:count]
    columns.flat[places] = np.arange(c - count, c)
    origins = 0.2 * rng.standard_normal((M, 3))
    sensed = Sensed(rng.integers(0, 2, M), origins, points - origins, np.full(M, -1))
    return SensedPoints(sensed, 0.05 * rng.standard_normal((2, 8)), columns, c)


def calls(compiled, rng):
    """Return functions of a compiled module, each with arguments that are right."""
    taken = []

    def taking(name):
        def call(*arguments):
            taken.append((getattr(compiled, name), arguments))
            return taken[-1][0](*arguments)

        return call

    recorder = SimpleNamespace(
        **{name: taking(name) for name in ('linearise', 'eliminate', 'fill_in')}
    )
    smoother, start = random_smoother(rng)
    smoother._linearised_by(recorder, start, bool(rng.integers(2)))
    equations = any_equations(rng)
    chain = bordered_chain._Compiled(recorder, equations)
    chain.fill_in(rng.standard_normal(len(chain.corner)))
    return taken


def fuzz(compiled, seed, rounds):
    """Call all functions with arguments that are right and with wrong ones; count refusals."""
    rng = np.random.default_rng(seed)
    return sum(refusals(rng, calls(compiled, rng)) for _ in range(rounds))
