"""Random smoothing problems with their dense solutions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.events import POINT
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.keyframes import (
    Keyframes,
    Links,
    no_keyframes,
    SeenTurns,
    Solution,
)
from slam_observer_ros.smoothing.prior import Prior

LEAST_SQUARES = Settings(huber_threshold=0.0, rejection_threshold=1e9)
POSES, LANDMARKS = 5, 4


def random_covariances(rng, count, size, scale):
    roots = rng.normal(size=(count, size, size))
    return scale**2 * (roots @ roots.swapaxes(1, 2) / size + 0.1 * np.eye(size))


class Problem:
    """A random smoothing problem whose residuals are far from zero, and its dense solution.

    Its unknowns are x = (η_0 … η_S, dc, dp) as in the module's text, or, where the calibration
    drifts, (η_0, dc_0 … η_S, dc_S, dp). With ``tags``, dp_i of a landmark ends in its turn.
    """

    def __init__(
        self,
        axes,
        calibrations,
        seed,
        is_relative=False,
        known_landmarks=2,
        drifts=False,
        tags=False,
    ):
        rng = np.random.default_rng(seed)
        d, k, c = axes.p, axes.point, calibrations
        self.axes = axes if tags else axes.of_points()
        self.d, self.k, self.c, self.drifts, self.q = d, k, c, drifts, self.axes.turn
        self.settings = replace(LEAST_SQUARES, calibration_drift=float(drifts))
        motions = se3.exp(self._tangents(0.3 * rng.normal(size=(POSES, d))))
        prior_size = d + c + (k + self.q) * known_landmarks
        points = axes.full_points(rng.normal(scale=3.0, size=(LANDMARKS, k)))
        self.prior = Prior(
            se3.exp(self._tangents(rng.normal(size=(1, d))))[0],
            0.1 * rng.normal(size=c),
            points[:known_landmarks]
            + 0.05 * axes.full_points(rng.normal(size=known_landmarks * k)),
            np.zeros((known_landmarks, 3, 3)),
            random_covariances(rng, 1, prior_size, 0.1)[0],
            is_relative,
        )
        keyframes = np.repeat(np.arange(POSES), 3)
        landmarks = np.concatenate([rng.permutation(LANDMARKS)[:3] for _ in range(POSES)])
        poses = np.array([self.prior.pose])
        for motion in motions:
            poses = np.concatenate([poses, poses[-1:] @ motion])
        seen = se3.transform(se3.inverse(poses[keyframes + 1]), points[landmarks][:, None])[
            :, 0
        ] + 0.1 * axes.full_points(rng.normal(size=len(keyframes) * k))
        none = no_keyframes(d, c, k, self.q)
        self.keyframes = Keyframes(
            Links(
                motions,
                random_covariances(rng, POSES, d, 0.1),
                0.2 * rng.normal(size=(POSES, d, c)),
            ),
            none.slips,
            none.slipped,
            0.1 * rng.normal(size=(POSES, c)),
            random_covariances(rng, POSES, c, 0.1) if c else np.empty((POSES, 0, 0)),
            keyframes,
            landmarks,
            seen,
            np.linalg.inv(random_covariances(rng, len(keyframes), k, 0.1)),
            rng.uniform(0.1, 1.0, len(keyframes)),
            np.full(len(keyframes), POINT),
            np.zeros((len(keyframes), 3)),
            none.turns,
        )
        eta = self._tangents(0.1 * rng.normal(size=(POSES + 1, d)))
        no_turns = np.zeros((len(points), 3, 3))
        self.start = Solution(poses @ se3.exp(eta), np.zeros((POSES + 1, c)), points, no_turns)
        if tags:
            self._add_turns(rng, poses[keyframes + 1, :3, :3], landmarks, known_landmarks)

    def _add_turns(self, rng, R, landmarks, known_landmarks):
        """Turn the landmarks, and let that be seen from poses turned by ``R`` (M, 3, 3)."""
        q, M = self.q, len(landmarks)
        B = self._turned(rng.normal(size=(LANDMARKS, q)))
        Z = R.swapaxes(1, 2) @ B[landmarks] @ self._turned(0.1 * rng.normal(size=(M, q)))
        # As far as these are from each other, no flip does harm.
        flipped = Z @ so3.exp(np.full((M, 3), 1e-3))
        information = np.linalg.inv(random_covariances(rng, M, q, 0.1))
        turns = SeenTurns(np.arange(M), Z, flipped, information)
        self.keyframes = replace(self.keyframes, turns=turns)
        of_prior = self._turned(0.05 * rng.normal(size=(known_landmarks, q)))
        self.prior = replace(self.prior, orientations=of_prior @ B[:known_landmarks])
        self.start = replace(
            self.start, orientations=self._turned(0.1 * rng.normal(size=(LANDMARKS, q))) @ B
        )

    def _turned(self, vectors):
        return so3.exp(self.axes.full_turns(vectors))

    def _tangents(self, coordinates):
        full = np.zeros((len(coordinates), 6))
        full[:, self.axes.pose] = coordinates
        return full

    def moved(self, solution, x):
        chained = self.d + (self.c if self.drifts else 0)
        end = (POSES + 1) * chained
        chain = x[:end].reshape(-1, chained)
        shared = 0 if self.drifts else self.c
        calibrations = chain[:, self.d :] if self.drifts else x[end : end + shared]
        changes = x[end + shared :].reshape(LANDMARKS, -1)
        orientations = solution.orientations
        return Solution(
            solution.poses @ se3.exp(self._tangents(chain[:, : self.d])),
            solution.calibrations + calibrations,
            solution.points + self.axes.full_points(changes[:, : self.k].ravel()),
            self._turned(changes[:, self.k :]) @ orientations,
        )

    def residuals(self, solution):
        """All residuals, whitened: the cost is half the sum of their squares."""
        pose, keyframes = self.axes.pose, self.keyframes
        known, prior_points = solution.points[: len(self.prior.points)], self.prior.points
        if self.prior.is_relative:
            known = se3.transform(se3.inverse(solution.poses[0]), known)
            prior_points = se3.transform(se3.inverse(self.prior.pose), prior_points)
        off = [
            se3.log(se3.inverse(self.prior.pose) @ solution.poses[0])[pose],
            solution.calibrations[0] - self.prior.calibration,
            np.hstack([(known - prior_points)[:, : self.k], self._prior_turns(solution)]).ravel(),
        ]
        whitened = [whiten(np.linalg.inv(self.prior.covariance), np.concatenate(off))]
        for s in range(POSES):
            by_calibration = keyframes.links.sensitivities[s] @ (
                solution.calibrations[s] - keyframes.calibrations[s]
            )
            motion = keyframes.links.motions[s] @ se3.exp(self._tangents(by_calibration[None])[0])
            step = se3.inverse(solution.poses[s]) @ solution.poses[s + 1]
            error = se3.log(se3.inverse(motion) @ step)[pose]
            whitened.append(whiten(np.linalg.inv(keyframes.links.covariances[s]), error))
            if self.drifts:
                drift = solution.calibrations[s + 1] - solution.calibrations[s]
                whitened.append(whiten(np.linalg.inv(keyframes.drift_covariances[s]), drift))
        counted = keyframes.information * keyframes.shares[:, None, None]
        seen = keyframes.keyframes, keyframes.landmarks, keyframes.points
        for keyframe, landmark, point, information in zip(*seen, counted, strict=True):
            back = se3.inverse(solution.poses[keyframe + 1])
            error = se3.transform(back, solution.points[None, landmark])[0] - point
            whitened.append(whiten(information, error[: self.k]))
        return np.concatenate(whitened + (self._seen_turns(solution) if self.q else []))

    def _prior_turns(self, solution):
        """Return how the prior's landmarks are turned off it, (n, 0) if that is not estimated."""
        if not self.q:
            return np.empty((len(self.prior.points), 0))
        before, now = self.prior.orientations, solution.orientations[: len(self.prior.points)]
        if self.prior.is_relative:
            before = self.prior.pose[:3, :3].T @ before
            now = solution.poses[0, :3, :3].T @ now
        return self.axes.turns(so3.log(now @ before.swapaxes(1, 2)))

    def _seen_turns(self, solution):
        """Return the whitened errors of the orientations seen."""
        keyframes, turns = self.keyframes, self.keyframes.turns
        R = solution.poses[keyframes.keyframes + 1, :3, :3]
        seen = turns.Z.swapaxes(1, 2)
        predicted = R.swapaxes(1, 2) @ solution.orientations[keyframes.landmarks]
        errors = self.axes.turns(so3.log(predicted @ seen))
        counted = turns.information * keyframes.shares[:, None, None]
        return [whiten(W, error) for W, error in zip(counted, errors, strict=True)]

    def jacobian(self, solution, h=1e-6):
        calibrations = (POSES + 1 if self.drifts else 1) * self.c
        of_landmarks = (self.k + self.q) * LANDMARKS
        size = (POSES + 1) * self.d + calibrations + of_landmarks
        columns = [
            self.residuals(self.moved(solution, h * x))
            - self.residuals(self.moved(solution, -h * x))
            for x in np.eye(size)
        ]
        return np.array(columns).T / (2 * h)


def whiten(information, error):
    return np.linalg.cholesky(information).T @ error
