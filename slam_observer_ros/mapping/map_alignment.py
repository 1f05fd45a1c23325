"""The transform between the frames of two maps: by landmarks that both have, or by one tag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from itertools import combinations
import logging
import math
from typing import Any

import numpy as np

from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.known_landmarks import anchor, JITTER_M2, KnownLandmarks
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import definite_inverse, solve_symmetric
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.mapping.landmark_map import LandmarkMap, SAME_M, SAME_SHARE
from slam_observer_ros.tracking.state import State

logger = logging.getLogger(__name__)

# Standard deviation about any axis beyond which landmarks don't determine the attitude. Three of
# them in a line leave the roll about it open; two that are close together, the heading.
MAX_TURN_STD_RAD = 0.2
CONTRADICTION_SIGMAS = 4.0  # landmarks whose misfit is as improbable as this contradict each other


def find_transform(
    source: FloatArray, source_covariance: FloatArray, target: KnownLandmarks, axes: EstimatedAxes
) -> tuple[FloatArray, BoolArray] | None:
    """Find the transform between the frames of two maps, even if some landmarks are wrong.

    Parameters
    ----------
    source : FloatArray
        (m, 3) landmarks in the robot's own frame, metres.
    source_covariance : FloatArray
        (p + m k, p + m k) covariance of the pose's error and theirs together, rad² and m².
    target : KnownLandmarks
        The same m landmarks in the other frame.
    axes : EstimatedAxes
        Whether they lie in space (k = 3) or in a plane (k = 2).

    Returns
    -------
    tuple or None
        Transform (4, 4) from the robot's frame to the other one, and the landmarks (m,) that
        agree on it. None unless these are at least k and half of all, as of many landmarks some
        few fit by chance, and determine the attitude.

    """
    from scipy import special  # which few runs need; scipy.stats takes a second to import

    p, k = axes.p, axes.point
    J = axes.output_matrix(source).reshape(len(source) * k, p)
    G = np.vstack([np.eye(p), J])
    agree = np.ones(len(source), dtype=np.bool_)
    while agree.sum() >= max(k, 0.5 * len(source)):
        # Align the landmarks that are left.
        rows = np.flatnonzero(np.append(np.ones(p, dtype=np.bool_), np.repeat(agree, k)))
        P = source_covariance[np.ix_(rows, rows)]
        known = target.select(agree)
        variances = np.diagonal(P[p:, p:]).reshape(-1, k).sum(axis=1)
        variances = variances + np.trace(known.covariances, axis1=1, axis2=2) + JITTER_M2
        T = rigid_alignment(source[agree], known.points, 1.0 / variances)
        # Compare them in the robot's frame: do they determine the attitude, do they agree?
        known = known.moved(se3.inverse(T))
        there = known.covariance_on(axes)
        r = (source[agree] - known.points)[:, :k]
        if _turn_std_rad(P, G[rows], there, axes) > MAX_TURN_STD_RAD:
            return None
        misfit, doubts = _contradictions(G[rows[p:]], P[p:, p:] + there, r)
        if misfit <= special.chdtri(r.size - p, 2.0 * special.ndtr(-CONTRADICTION_SIGMAS)):
            return T, agree
        # Leave out the worst one.
        agree[np.flatnonzero(agree)[np.argmax(doubts)]] = False
    return None


def _turn_std_rad(P: FloatArray, G: FloatArray, there: FloatArray, axes: EstimatedAxes) -> float:
    """Return the attitude's standard deviation about the worst axis; parameters as `anchor`'s."""
    turns, rows = axes.p - axes.point, np.arange(axes.p, len(P))
    try:
        S = P[np.ix_(rows, rows)] + there
        _, after = anchor(P, G, P[:, rows], S, G[rows], np.zeros(len(rows)))
    except np.linalg.LinAlgError:
        return np.inf
    # Where landmarks leave a turn open, rounding decides whether its variance is +∞ or −∞.
    return float(np.sqrt(np.abs(np.linalg.eigvalsh(after[:turns, :turns])).max()))


def _contradictions(J: FloatArray, S: FloatArray, r: FloatArray) -> tuple[float, FloatArray]:
    """Return how badly differences (m, k) fit together, squared, and each by itself (m,).

    Each is judged as in Baarda's data snooping, by what the others leave of it: Q r, with
    Q = S⁻¹ − S⁻¹ J (Jᵀ S⁻¹ J)⁻¹ Jᵀ S⁻¹, in units of its standard deviation.
    """
    weights = definite_inverse(S + JITTER_M2 * np.eye(len(S)))
    W = weights @ J
    Q = weights - W @ solve_symmetric(J.T @ W, W.T)
    left = Q @ r.ravel()
    variances = np.maximum(np.diagonal(Q), 1e-6 * np.diagonal(weights))
    return float(r.ravel() @ left), np.sum((left**2 / variances).reshape(r.shape), axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Likeness:
    """A motion after which landmarks are nearly where a map has them."""

    transform: FloatArray  # (4, 4)
    is_same: BoolArray  # (n,) which landmarks are then where others are

    @property
    def turn_deg(self) -> float:
        """By how much it turns, degrees, 0 to 180."""
        return float(np.rad2deg(np.linalg.norm(so3.log(self.transform[:3, :3]))))

    @property
    def moved(self) -> str:
        """How it moves the map, in words that follow a comma; empty if it does not."""
        turn_deg, shift_m = self.turn_deg, self.transform[:3, 3]
        x, y, z = shift_m.tolist()
        # Less is no other place, and may come of the errors of a few landmarks.
        is_turned, is_shifted = turn_deg > LEAST_TURN_DEG, np.linalg.norm(shift_m) > SAME_M
        turned = f', turned by {turn_deg:.0f}°' if is_turned else ''
        joint = ' and' if is_turned else ','
        return turned + (f'{joint} shifted by ({x:.1f}, {y:.1f}, {z:.1f}) m' if is_shifted else '')


LEAST_TURN_DEG = 6.0  # least turn about the vertical that makes another place


def likeness_by_ids(known: LandmarkMap, other: LandmarkMap) -> Likeness | None:
    """Return how a map is to be moved to be another, or a part of it, by their ids; or None."""
    _, own, others = np.intersect1d(known.ids, other.ids, return_indices=True)
    smaller = min(len(known.ids), len(other.ids))
    needed = max(SAME_SHARE * smaller, LEAST_SAME)
    points, targets = known.world_points[own], other.world_points[others]
    is_same = np.ones(len(own), dtype=np.bool_)
    while np.count_nonzero(is_same) >= needed:
        T = rigid_alignment(points[is_same], targets[is_same])
        off_m = np.linalg.norm(se3.transform(T, points) - targets, axis=1)
        worst_m = float(off_m[is_same].max())
        if worst_m <= SAME_M:
            are_same = np.zeros(len(known.ids), dtype=np.bool_)
            are_same[own[off_m <= SAME_M]] = True
            return Likeness(T, are_same)
        # Some that were moved shift all others, but by less than they are off themselves.
        is_same &= off_m <= 0.5 * worst_m
    return None


LEAST_SAME = 3  # landmarks that show that maps are one: of two alone only a distance has to fit


class AlikeMaps:
    """Which of several maps are another one, moved; of each that is logged once."""

    def __init__(
        self,
        maps: Sequence[LandmarkMap],
        likeness: Callable[[LandmarkMap, LandmarkMap], Likeness | None],
    ) -> None:
        self._findings: dict[tuple[int, int], Finding] = {}
        for (i, first), (j, second) in combinations(enumerate(maps), 2):
            if (alike := likeness(first, second)) is None:
                continue
            self._findings[i, j] = finding = found(
                'alike_maps',
                other=first.name,
                name=second.name,
                count=np.count_nonzero(alike.is_same),
                moved=alike.moved,
            )
            if not any((k, j) in self._findings for k in range(i)):
                logger.warning('%s', finding)

    def among(self, maps: Iterable[int]) -> Finding | None:
        """Return what is to be said of two of these maps, by number, that are alike; or None."""
        pairs = combinations(sorted(set(maps)), 2)
        return next((self._findings[pair] for pair in pairs if pair in self._findings), None)


class Differences:
    """Whether what is seen is where another map, which is alike, has it, and not this one."""

    def __init__(self, known: LandmarkMap, maps: Iterable[LandmarkMap]) -> None:
        # By the other map's name: points that it alone has, and that this one alone has, here.
        self._points: dict[str, tuple[FloatArray, FloatArray]] = {}
        for other in maps:
            alike = None if other is known else likeness_by_ids(other, known)
            if alike is not None and not alike.is_same.all():
                theirs = se3.transform(alike.transform, other.world_points[~alike.is_same])
                is_ours = ~np.isin(known.ids, other.ids[alike.is_same])
                self._points[other.name] = theirs, known.world_points[is_ours]
        self._votes = Counter[str]()

    def note(self, state: State, event: ObservationEvent) -> str:
        """Take an observation in the map; return the other one that it is in by now, or ''."""
        if not self._points or event.kinds is not None:
            return ''
        pose = state.observer.pose
        seen, noise = se3.transform(pose, event.points), state.observation_noise.covariances(event)
        near_m = SAME_M + NEAR * np.sqrt(np.trace(noise, axis1=1, axis2=2))
        for name, each in self._points.items():
            for_it, against = (
                (np.linalg.norm(seen[:, None] - points, axis=2) < near_m[:, None]).any(axis=1)
                for points in each
            )
            vote = int((for_it & ~against).any()) - int((against & ~for_it).any())
            self._votes[name] = max(self._votes[name] + vote, 0)
            if self._votes[name] >= state.settings.max_rejections:
                return name
        return ''


NEAR = 3.0  # standard deviations of a point within which it is where a landmark is
SIGHTINGS = 2  # sightings of a tag that must agree: a single one may be flipped


@dataclass(frozen=True, slots=True, eq=False)
class TagPose:
    """What a tag says of where the robot is."""

    tag_id: int
    pose: FloatArray  # (4, 4) in the map
    covariance: FloatArray  # (6, 6) of rotation vector and position, rad² and m², map axes
    known: LandmarkMap  # the map


def pose_by_tag(state: State, known: LandmarkMap, refused: AbstractSet[int]) -> TagPose | None:
    """Return the pose in a map by the tag that says it best, but for ``refused`` ids; or None."""
    tags, R, sigmas = state.observer.orientations, known.orientations, known.orientation_sigmas
    if R is None or sigmas is None:
        return None
    # Tags that both have, and that were seen the same way each time.
    rows, landmarks = state.landmarks.rows_of(known.ids), state.landmarks
    shared = np.flatnonzero((rows >= 0) & R.any(axis=(1, 2)))
    shared = shared[~np.isin(known.ids[shared], list(refused))]
    own = rows[shared]
    is_sure = tags.are_known[own] & (tags.counts[own] >= SIGHTINGS) & (tags.rejections[own] == 0)
    is_sure &= landmarks.counts[own] >= SIGHTINGS
    shared, own = shared[is_sure], own[is_sure]
    if not len(own):
        return None
    turn_stds = np.hypot(state.known_errors.orientation_sigmas(own), sigmas[shared])
    best = int(np.argmin(turn_stds))
    if turn_stds[best] > MAX_TURN_STD_RAD:
        return None
    at, row, A = shared[best], own[best : best + 1], state.observer.A
    # From the frame of P° to the map: by how the tag is turned, and where it is.
    turn = R[at] @ state.known_errors.orientation_matrices(row)[0].T
    lever = turn @ (A[:3, 3] - state.observer.points[row[0]])
    pose = se3.pose(turn @ A[:3, :3], known.world_points[at] + lever)
    # An error of the tag's turn moves the robot about it.
    J = np.vstack([np.eye(3), -so3.hat(lever)])
    covariance = turn_stds[best] ** 2 * J @ J.T
    covariance[3:, 3:] += known.covariances_or(state.settings.map_noise)[at]
    seen, k = state.configuration_covariance(row), state.axes.point
    if seen is not None:
        relative = np.zeros((3, 3))
        relative[:k, :k] = seen
        covariance[3:, 3:] += pose[:3, :3] @ relative @ pose[:3, :3].T
    return TagPose(int(known.ids[at]), pose, covariance, known)


MAX_ALIKE = 64  # landmarks that the outermost one of a map is taken to be, at most
CELLS = 40  # along the longer side of a map, free places for one more landmark


def symmetries(known: LandmarkMap) -> list[Likeness]:
    """Return upright turns after which a map looks the same: the best first, then the smallest."""
    turned = [each for each in turns_onto(known, known) if each.turn_deg > LEAST_TURN_DEG]
    return sorted(turned, key=lambda each: (-int(each.is_same.sum()), round(each.turn_deg)))


def turns_onto(known: LandmarkMap, other: LandmarkMap) -> list[Likeness]:
    """Return the turns about the vertical after which a map looks as another, whatever its ids.

    Any of these takes the landmarks' centre to the other, and the outermost to one as far out.
    """
    from scipy.spatial import cKDTree  # which few runs need

    points, others = known.world_points, other.world_points
    sizes = sorted((len(points), len(others)))
    if sizes[0] < LEAST_SAME or sizes[0] < SAME_SHARE * sizes[1]:
        return []
    radii_m, angles = _from_centre(points)
    other_radii_m, other_angles = _from_centre(others)
    first, tree = int(np.argmax(radii_m)), cKDTree(others)
    tolerance_m = SAME_M + 2.0 * radii_m[first] * (1.0 - SAME_SHARE)
    off_m = np.abs(other_radii_m - radii_m[first])
    alike = np.argsort(off_m)[: min(MAX_ALIKE, int(np.count_nonzero(off_m < tolerance_m)))]
    found: list[Likeness] = []
    for angle in other_angles[alike] - angles[first]:
        likeness = _fitted(points, others, tree, angle)
        T = likeness.transform
        turns_rad = [so3.log(T[:3, :3] @ each.transform[:3, :3].T) for each in found]
        is_new = all(np.linalg.norm(turn) > math.radians(LEAST_TURN_DEG) for turn in turns_rad)
        if is_new and likeness.is_same.mean() >= SAME_SHARE:
            found.append(likeness)
    return found


def _from_centre(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far points are from their centre, metres, and in which direction, rad."""
    offsets = points - points.mean(axis=0)
    return np.linalg.norm(offsets[:, :2], axis=1), np.arctan2(offsets[:, 1], offsets[:, 0])


def _fitted(points: FloatArray, others: FloatArray, tree: Any, angle: float) -> Likeness:
    """Return the turn by about an angle that fits best, the nearest landmarks being the same."""
    centre, other_centre = points.mean(axis=0), others.mean(axis=0)
    R = so3.exp(np.array([0.0, 0.0, angle]))
    T = se3.pose(R, other_centre - R @ centre)
    flat = np.array([1.0, 1.0, 0.0])
    for tolerance_m in (10.0 * SAME_M, 3.0 * SAME_M, SAME_M):
        distances_m, near = tree.query(se3.transform(T, points))
        is_same = distances_m <= tolerance_m
        if is_same.mean() < SAME_SHARE:
            break
        z_m = (others[near[is_same]] - points[is_same])[:, 2].mean()
        T = rigid_alignment(points[is_same] * flat, others[near[is_same]] * flat)
        T[2, 3] = z_m
    return Likeness(T, np.asarray(is_same))


def place_for_another(known: LandmarkMap, symmetry: Likeness) -> FloatArray:
    """Return where (3,) one more landmark shows best which way round the map is, metres.

    Among free places in the map, that which is furthest from all landmarks, from where these would
    be if the map was turned, and from where it would be itself.
    """
    from scipy.spatial import cKDTree

    points, T = known.world_points, symmetry.transform
    low, high = points.min(axis=0)[:2], points.max(axis=0)[:2]
    step_m = max(float((high - low).max()) / CELLS, 1e-3)
    x, y = np.meshgrid(
        *(np.arange(a, b + 0.5 * step_m, step_m) for a, b in zip(low, high, strict=True))
    )
    free = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, np.median(points[:, 2]))])
    own = np.linalg.norm((free - se3.transform(T, free))[:, :2], axis=1)
    tree, turned = cKDTree(points[:, :2]), cKDTree(se3.transform(T, points)[:, :2])
    from_others = np.minimum(tree.query(free[:, :2])[0], turned.query(free[:, :2])[0])
    best: FloatArray = free[np.argmax(np.minimum(from_others, 0.5 * own))]
    return best
