"""What is said of residuals: their density is a normal distribution's, all together."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam_observer_ros.tracking.matching import Expected


def expected(m=3, k=2):
    rng = np.random.default_rng(4)
    root = rng.standard_normal((m * k, m * k))
    R = np.tile(np.eye(k), (m, 1, 1))
    return Expected(rng.standard_normal((m, k)), np.ones(m), R, root @ root.T + np.eye(m * k))


@pytest.mark.parametrize('weights', [[1.0, 1.0, 1.0], [1.0, 0.0, 0.3], [0.0, 0.0, 1.0]])
def test_the_densities_of_what_is_used_are_together_the_joint_one(weights):
    what, used = expected(), np.repeat(np.array(weights) > 0.0, 2)
    judged = what.judge(np.array(weights), np.ones(3))
    r, S = what.r.ravel()[used], what.S[np.ix_(used, used)]
    nis = r @ np.linalg.solve(S, r)
    log_density = -0.5 * (nis + np.linalg.slogdet(2.0 * math.pi * S)[1])
    assert judged.nis == pytest.approx(nis)
    assert judged.degrees_of_freedom == len(r)
    assert judged.log_densities[np.array(weights) > 0.0].sum() == pytest.approx(log_density)
    assert np.isneginf(judged.log_densities[np.array(weights) == 0.0]).all()


def test_where_nothing_is_used_nothing_is_likely():
    judged = expected().judge(np.zeros(3), np.ones(3))
    assert judged.nis is None
    assert np.isneginf(judged.log_densities).all()
