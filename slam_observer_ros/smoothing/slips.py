"""Which of the slips that a filter has believed in the whole history confirms.

A filter takes the robot for slipped by what it has seen until then, which what follows may
explain otherwise. A link that may be a slip has a thousand times the variance of one that is not,
so a false one lets a part of the map drift off. All links are therefore taken as odometry has
them at first, and nothing is gated: what speaks against a false slip would be. A link becomes a
slip where that pays: where it makes the error e of the motion likelier,

    eᵀ S⁻¹ e − eᵀ S_s⁻¹ e > ln (|S_s| / |S|)

with S the covariance that odometry states and S_s that with the slip.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.smoothing.keyframes import Keyframes, Solution
from slam_observer_ros.smoothing.prior import inverse

ROUNDS = 10
"""Times, at most, that it is asked which slips pay; the answer hardly changes after the third."""


def confirmed_slips(
    solve: Callable[[Keyframes, Solution], Solution],
    motion_errors: Callable[[Keyframes, Solution], FloatArray],
    keyframes: Keyframes,
    start: Solution,
) -> tuple[BoolArray, Solution]:
    """Return which of the keyframes' slips (s,) pay, and a solution with these, not gated.

    ``solve`` smooths keyframes from a start, not gated, and raises LinAlgError as
    :meth:`.Smoother.smooth` does; ``motion_errors`` are the errors of links in a solution.
    """
    are_slips = np.zeros(len(keyframes.slips), dtype=np.bool_)
    solution = start
    for _ in range(ROUNDS):
        solution = solve(keyframes.with_slips(are_slips), solution)
        as_stated = motion_errors(keyframes, solution)
        pay = _pay(keyframes, as_stated[keyframes.slips])
        if np.array_equal(pay, are_slips):
            break
        are_slips = pay
    return are_slips, solution


def _pay(keyframes: Keyframes, errors: FloatArray) -> BoolArray:
    """Return which slips (s,) make the errors (s, d) of their motions likelier."""
    stated = inverse(keyframes.links.covariances[keyframes.slips])
    slipped = inverse(keyframes.slipped.covariances)
    paid = np.einsum('si,sij,sj->s', errors, stated - slipped, errors)
    price = np.linalg.slogdet(stated)[1] - np.linalg.slogdet(slipped)[1]
    return np.asarray(paid > price)
