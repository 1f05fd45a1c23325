"""Hypothesis strategies for the geometry: rotations at every scale, poses, SLAM_n(3) elements.

They are made once each: what hypothesis finds out of one costs more than to draw from it.
"""

from __future__ import annotations

from functools import cache

from hypothesis import strategies as st
import numpy as np
from slam_group import SlamElement, SlamVelocity, TotalState

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3

LANDMARK_COUNTS = (0, 1, 25)

# Where numerics are delicate: at and next to zero, on both sides of the switch to a series in
# `se3.left_jacobian` (θ² = 0.1), around π/2 and 2π/3 (where the quaternion's largest entry
# changes), and close to half a turn.
DELICATE_ANGLES = (
    0.0,
    1e-160,
    1e-12,
    1e-8,
    1e-4,
    1e-2,
    1.0,
    np.sqrt(0.1) - 1e-9,
    np.sqrt(0.1) + 1e-9,
    np.pi / 2,
    2 * np.pi / 3,
    np.pi - 1e-4,
    np.pi - 1e-8,
    np.pi - 1e-12,
)


@cache
def generators() -> st.SearchStrategy[np.random.Generator]:
    """Random generators: bulk values come from these, which is faster than drawing each."""
    return st.integers(0, 2**32 - 1).map(np.random.default_rng)


@cache
def angles() -> st.SearchStrategy[float]:
    """Rotation angles from 0 to just below π, rad."""
    return st.one_of(st.sampled_from(DELICATE_ANGLES), st.floats(0.0, np.pi - 1e-12))


@cache
def unit_vectors() -> st.SearchStrategy[FloatArray]:
    """Axes of shape (3,), the coordinate axes among them."""
    components = st.floats(-1.0, 1.0, allow_subnormal=False)
    vectors = st.tuples(components, components, components).map(np.array)
    return vectors.filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))


@cache
def rotation_vectors() -> st.SearchStrategy[FloatArray]:
    """Rotation vectors of shape (3,), |φ| < π, rad."""
    return st.builds(lambda angle, axis: angle * axis, angles(), unit_vectors())


@cache
def rotations() -> st.SearchStrategy[FloatArray]:
    """Rotation matrices of shape (3, 3)."""
    return rotation_vectors().map(so3.exp)


@cache
def directions(scale: float = 10.0) -> st.SearchStrategy[FloatArray]:
    """Vectors of shape (3,) with entries up to `scale`, zero among them."""
    entries = st.floats(-scale, scale, allow_subnormal=False)
    return st.tuples(entries, entries, entries).map(np.array)


@cache
def twists() -> st.SearchStrategy[FloatArray]:
    """Twists (Ω, v) of shape (6,) with |Ω| < π."""
    return st.builds(lambda phi, v: np.concatenate([phi, v]), rotation_vectors(), directions())


@cache
def poses() -> st.SearchStrategy[FloatArray]:
    """Poses of shape (4, 4) within 10 m of the origin on each axis."""
    return st.builds(se3.pose, rotations(), directions())


@cache
def points(n: int) -> st.SearchStrategy[FloatArray]:
    """Points or velocities of shape (n, 3) with entries of the order of 5."""
    return generators().map(lambda random: random.normal(scale=5.0, size=(n, 3)))


@cache
def elements(n: int) -> st.SearchStrategy[SlamElement]:
    """Elements of SLAM_n(3)."""
    return st.builds(SlamElement, poses(), points(n))


@cache
def states(n: int) -> st.SearchStrategy[TotalState]:
    """Raw states of T_n(3)."""
    return st.builds(TotalState, poses(), points(n))


@cache
def velocities(n: int) -> st.SearchStrategy[SlamVelocity]:
    """Inputs of the space (19)."""
    return st.builds(SlamVelocity, twists(), points(n))
