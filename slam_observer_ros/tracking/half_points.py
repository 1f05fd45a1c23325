"""Half points, bearings or ranges alone, completed to points that the step can use.

A half point is a point once there is something to complete it with: of a known landmark by the
estimate, at each observation, which is where the residual is linearised; of a new one by the past
(:mod:`.waiting_room`). In the directions that were not measured a completed point may be off by
``UNMEASURED_M``; a step takes the rows H = uᵀ of the directions that were measured alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Outcomes, Reason, Update
from slam_observer_ros.events import (
    AZIMUTH,
    AZIMUTH_RANGE,
    BEARING,
    ObservationEvent,
    POINT,
    RANGES,
)
from slam_observer_ros.filter.robust import straight_odds, straight_share
from slam_observer_ros.lie.matrices import diagonal_blocks, transpose
from slam_observer_ros.lie.sensor_mounting import (
    completed_lines,
    directions_of,
    LEAST_M,
    MEASURED,
    measured_axes,
    unmeasured_covariances,
    without_bias,
)
from slam_observer_ros.models.calibration import SCALE
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.models.point_noise import point_covariances
from slam_observer_ros.tracking.covariances import turn_to_world
from slam_observer_ros.tracking.matching import calibrated, residuals_of
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.waiting_room import (
    LEAST_MOVE_M,
    sensor_values,
    WaitingRoom,
    Window,
)

KEPT, FEWEST = 200, 40  # differences of ranges that are kept, and that it takes to judge them
LEAST_ANCHORS = 3  # landmarks among which one that is off is known from those that are not
LEAST_SHARE = 1e-3  # probability of a straight way below which a range says nothing, either way

LEAST_LEVEL = 0.1
"""Cosine of the steepest line of sight, 84°, whose range says something in the plane."""


class HalfPoints:
    """Completes what sensors measure, by a state and by the views that wait."""

    def __init__(self, counts: Outcomes) -> None:
        self._counts = counts
        self._waiting, self.window = WaitingRoom(), Window()
        self.heights_m: Mapping[int, float] = {}  # of the landmarks of a loaded map
        self.offsets = RangeOffsets()
        self.mapped_ids = np.empty(0, dtype=np.int64)  # of the landmarks of loaded maps

    def clear(self) -> None:
        """Forget the views that wait: time or frame are others."""
        self._waiting, self.window = WaitingRoom(), Window()
        self.offsets = RangeOffsets()

    def remember(self, states: Sequence[State]) -> bool:
        """Let the pasts of ``states`` know what is seen by the views that wait, or waited.

        Return whether a landmark has entered since the last time, which may move the robot.
        """
        return self._waiting.remember(states)

    @property
    def open_sides(self) -> list[int]:
        """Ids of new landmarks whose views fit two places."""
        return sorted(self._waiting.open_sides)

    def levelled(self, event: ObservationEvent, noise: ObservationNoise) -> ObservationEvent:
        """Return ranges in space as they are in the plane, where landmarks' heights are known."""
        if event.kinds is None or not self.heights_m:
            return event
        lines = event.lines_of_sight
        sensor_z = event.points[:, 2] - lines[:, 2]
        known = [self.heights_m.get(landmark_id, math.nan) for landmark_id in event.ids.tolist()]
        rise_m, range_m = np.array(known) - sensor_z, np.linalg.norm(lines, axis=1)
        has_slant = np.isin(np.asarray(event.kinds), RANGES) & (range_m > 0.0)
        slant = np.flatnonzero(has_slant & np.isfinite(rise_m))
        if not len(slant):
            return event
        share = np.clip(rise_m[slant] / range_m[slant], -1.0, 1.0)
        level = np.maximum(np.sqrt(1.0 - share**2), LEAST_LEVEL)[:, None]
        covariances = np.zeros((len(lines), 3, 3))  # where zero, the noise model's
        if event.covariances is not None:
            covariances[:] = event.covariances
        stated = covariances[slant]
        modelled = ~stated.any(axis=(1, 2))
        stated[modelled] = noise.at(lines[slant][modelled])
        # An error along the range is longer on the floor, one across it nearer.
        along = lines[slant] / range_m[slant, None]
        longer = (1.0 / level - level) * along
        M = level[:, :, None] * np.eye(3) + longer[:, :, None] * along[:, None, :]
        covariances[slant] = M @ stated @ M
        points = event.points.copy()
        points[slant] += (level - 1.0) * lines[slant]
        return replace(event, points=points, covariances=covariances)

    def completed(
        self, event: ObservationEvent, state: State, *, is_lost: bool
    ) -> ObservationEvent:
        """Return an observation whose points are whole; points of which nothing is known wait.

        Of a robot that ``is_lost`` in a map the points of its landmarks go to the :attr:`window`.
        """
        if event.kinds is None or not (event.kinds != POINT).any():
            return event
        rows = state.landmarks.rows_of(event.ids)
        anchors = _with_calibration(state, event, rows)
        lines, covariances, directions = _completed(state, event, rows)
        entered = np.zeros(len(rows), dtype=np.bool_)
        is_sought = is_lost & np.isin(event.ids, self.mapped_ids)
        if is_sought.any():
            _, measured, along = _completed(state, event, np.full(len(rows), -1))
            measured = measured + unmeasured_covariances(along)
            for row in np.flatnonzero(is_sought).tolist():
                self.window.add(state, event, row, measured[row])
        if state.is_mapping:
            is_new = (rows < 0) & (event.kinds != POINT) & ~is_sought
            self._waiting.begin(event.stamp_ns)
            measured = covariances + unmeasured_covariances(directions)
            for row in np.flatnonzero(is_new).tolist():
                found = self._waiting.add(state, event, row, measured[row])
                if found is not None:
                    lines[row], covariances[row] = found
                    directions[row] = np.eye(3)
                    entered[row] = True
        usable = (rows >= 0) | (event.kinds == POINT) | entered
        self._counts.note(Reason.WAITING, event.ids[~usable], event.stamp_ns)
        kinds = np.where(entered, POINT, np.asarray(event.kinds))
        anchors = np.where(usable, anchors, -1)
        points = event.points - event.lines_of_sight + lines
        whole = replace(
            event, points=points, covariances=covariances, kinds=kinds, directions=directions
        )
        whole = _curved(state, whole, rows)
        covariances = self._without_detours(state, whole, rows, event, anchors)
        whole = replace(whole, covariances=covariances).select(usable)
        # Else the step calibrates it, which knows no landmarks.
        return calibrated(state, whole, anchors[usable]) if (anchors >= 0).any() else whole

    def _without_detours(
        self,
        state: State,
        event: ObservationEvent,
        rows: IntArray,
        of_shown: ObservationEvent,
        anchors: IntArray,
    ) -> FloatArray:
        """Return the covariances (m, 3, 3) of a completed event, larger of ranges too long.

        A range that is long within the gate counts by the probability that it came straight: its
        variance is divided by that. Beyond the gate it is rejected as any other.
        """
        covariances = np.asarray(event.covariances)
        is_half = np.asarray(of_shown.kinds) != POINT
        measures = MEASURED[of_axes(of_shown.kinds, state)][:, 0]
        # Landmarks that ranges have put where they are have the detours of these in them.
        is_range = is_half & measures & (rows >= 0) & np.isin(event.ids, self.mapped_ids)
        by_calibration = calibrated(state, event.select(is_range), anchors[is_range])
        S = _expected_covariances(state, by_calibration, rows[is_range])
        if S is None:
            return covariances
        shown, lines = of_shown.lines_of_sight[is_range], event.lines_of_sight[is_range]
        ranges_m = np.linalg.norm(shown, axis=1)
        expected = expected_lines(state, of_shown.select(is_range), rows[is_range])
        off_m = ranges_m - np.linalg.norm(expected, axis=1)
        along = lines / np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-9)
        own = np.einsum('mi,mij,mj->m', along, covariances[is_range], along)
        sigmas_m = np.sqrt(np.einsum('mi,mij,mj->m', along, S, along))
        self.offsets.note(
            event.ids[is_range],
            off_m,
            state.calibration.biases(anchors[is_range])[0],
            sigmas_m,
            np.sqrt(own),
            state,
        )
        noise_m = self.offsets.noisier * sigmas_m
        share = straight_share(off_m / noise_m, straight_odds(noise_m, ranges_m))
        share[off_m > state.settings.rejection_threshold * sigmas_m] = 1.0
        more = own * (1.0 / np.maximum(share, LEAST_SHARE) - 1.0)
        larger: FloatArray = covariances.copy()
        larger[is_range] += more[:, None, None] * along[:, :, None] * along[:, None, :]
        return larger


class RangeOffsets:
    """By how much ranges from each landmark are longer than expected, along the way."""

    def __init__(self) -> None:
        self._of: dict[int, deque[tuple[float, float]]] = {}
        self._short: deque[float] = deque(maxlen=KEPT)
        self._last_at = np.full(3, np.inf)

    def note(
        self,
        ids: IntArray,
        off_m: FloatArray,
        biases_m: FloatArray,
        sigmas_m: FloatArray,
        own_m: FloatArray,
        state: State,
    ) -> None:
        """Note differences (m,) beside estimated biases, their deviations, the sensor's part."""
        at = state.observer.A[:3, 3]
        if np.linalg.norm(at - self._last_at) < LEAST_MOVE_M:
            return  # from one place all have the same error
        self._last_at = at.copy()
        for landmark_id, *difference in zip(
            ids.tolist(), (off_m + biases_m).tolist(), own_m.tolist(), strict=True
        ):
            kept = self._of.setdefault(landmark_id, deque(maxlen=KEPT))
            kept.append((difference[0], difference[1]))
        self._short.extend((-off_m / sigmas_m)[off_m < 0.0].tolist())

    @property
    def noisier(self) -> float:
        """How many times as noisy as stated ranges are: 1 or more, by those that are too short.

        Nothing but noise makes a range too short, so that detours have no part in it.
        """
        if len(self._short) < FEWEST:
            return 1.0
        return max(math.sqrt(float(np.mean(np.square(self._short)))), 1.0)

    @property
    def constant(self) -> dict[int, float]:
        """Metres by which landmarks' ranges are off everywhere, beyond what all have in common.

        In each quarter of what was seen of them they are so by at least half of it, and by more
        than a standard deviation of the sensor.
        """
        enough = {each: np.array(kept) for each, kept in self._of.items() if len(kept) >= FEWEST}
        if len(enough) < LEAST_ANCHORS:
            return {}
        medians = {each: float(np.median(kept[:, 0])) for each, kept in enough.items()}
        common = float(np.median(list(medians.values())))
        biased = {}
        for each, kept in enough.items():
            off_m = medians[each] - common
            quarters = [np.median(part) - common for part in np.array_split(kept[:, 0], 4)]
            is_constant = min(float(part) / off_m for part in quarters) > 0.5 if off_m else False
            if is_constant and abs(off_m) > float(np.median(kept[:, 1])):
                biased[each] = off_m
        return biased


def _expected_covariances(
    state: State, event: ObservationEvent, rows: IntArray
) -> FloatArray | None:
    """Return how far off points of landmarks may be seen (m, 3, 3), body axes, m²; or None."""
    if not len(rows):
        return None
    k = state.axes.point
    residuals = residuals_of(state, event, rows, np.asarray(event.covariances))
    S = state.gains.innovation_covariance(residuals)
    if not len(S):
        return None
    full = np.zeros((len(rows), 3, 3))
    full[:, :k, :k] = diagonal_blocks(S, k)
    R = state.observer.A[:3, :3]
    turned: FloatArray = R.T @ full @ R
    return turned


def _curved(state: State, event: ObservationEvent, rows: IntArray) -> ObservationEvent:
    """Return completed half points as they are of second order.

    Of δ, by how much a landmark at r may be off along and across its line, a range has δ⊥²/2r
    besides, and across a direction it is −δ∥ δ⊥/r. With a normal δ these have such means, by which
    the points are shifted, and variances, which add to theirs: n times, as all of n that are seen
    at once may be off alike.
    """
    half = np.flatnonzero((rows >= 0) & (np.asarray(event.kinds) != POINT))
    if state.errors is None or not len(half):
        return event
    directions, lines = np.asarray(event.directions)[half], event.lines_of_sight[half]
    basis = directions_of(lines)
    P = basis @ _apart(state, rows[half]) @ transpose(basis)
    with_along, across = P[:, 0, 1:], P[:, 1:, 1:]
    variances_across = np.diagonal(across, axis1=1, axis2=2)
    r = np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), LEAST_M)
    means = np.hstack([variances_across.sum(axis=1, keepdims=True) / 2.0, -with_along]) / r
    of_range = np.sum(across**2, axis=(1, 2))[:, None] / 2.0
    of_directions = P[:, :1, 0] * variances_across + with_along**2
    variances = len(half) * np.hstack([of_range, of_directions]) / r**2
    points, covariances = event.points.copy(), np.array(event.covariances)
    points[half] -= np.einsum('mij,mi->mj', directions, means)
    covariances[half] += transpose(directions) @ (variances[:, :, None] * directions)
    return replace(event, points=points, covariances=covariances)


def _apart(state: State, rows: IntArray) -> FloatArray:
    """Return how uncertain it is where landmarks ``rows`` are from the robot (m, 3, 3), body.

    Without the part α of it that turns with the robot's error of attitude θ, as where a whole map
    is turned: α G θ with the least of E‖δ − α G θ‖². An arc about the robot has no second order.
    """
    errors, (p, k) = state.known_errors, (state.axes.p, state.axes.point)
    robot, turns = state.observer.A[None, :3, 3], slice(0, p - k)
    # However the robot is turned: about itself that moves nothing.
    to_robot = state.axes.output_matrix(robot)[0]
    joint, full = errors.joint_covariance(rows), np.zeros((len(rows), 3, 3))
    P = errors.joint.pose if joint is None else joint[:p, :p]
    apart = np.tile(to_robot @ P @ to_robot.T, (len(rows), 1, 1))
    with_turn = np.tile(-to_robot @ P[:, turns], (len(rows), 1, 1))
    if joint is not None:
        with_robot = (to_robot @ joint[:p, p:]).reshape(k, -1, k).swapaxes(0, 1)
        apart += diagonal_blocks(joint[p:, p:], k) - with_robot - transpose(with_robot)
        with_turn += joint[p:, turns].reshape(-1, k, p - k)
    G = state.axes.output_matrix(state.observer.points[rows])[..., turns] - to_robot[:, turns]
    by_turn = G @ P[turns, turns]
    most = np.sum(by_turn * G, axis=(1, 2))
    share = np.sum(with_turn * G, axis=(1, 2)) / np.maximum(most, np.finfo(float).tiny)
    alpha = np.clip(share, 0.0, 1.0)[:, None, None]
    both = alpha * (G @ transpose(with_turn))
    full[:, :k, :k] = apart - both - transpose(both) + alpha**2 * (by_turn @ transpose(G))
    R = state.observer.A[:3, :3]
    seen: FloatArray = R.T @ full @ R
    return seen


def with_kinds(update: Update, event: ObservationEvent) -> Update:
    """Return what came of an observation with the kinds of its points."""
    if event.kinds is None:
        return update
    by_id = dict(zip(event.ids.tolist(), event.kinds.tolist(), strict=True))
    kinds = np.array([by_id.get(each, POINT) for each in update.ids.tolist()], dtype=np.int64)
    return replace(update, kinds=kinds)


def _with_calibration(state: State, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Let what is estimated of a calibration be known before it is asked for.

    Return the landmarks (m,) whose ranges have a bias, −1 for other points.
    """
    calibration, anchors = state.calibration, np.full(len(rows), -1)
    if calibration.corrects_points and event.sensor_frame not in calibration.sensors:
        state.calibrate(event.sensor_frame)
    if calibration.range_bias_m:
        is_range = np.isin(np.asarray(event.kinds), RANGES)
        anchors[is_range] = event.ids[is_range]
        state.calibrate_ranges(anchors[rows >= 0])
    return anchors


def take_scales(
    state: State, lost: State, scales: Mapping[str, float], covariance: FloatArray
) -> None:
    """Begin with ranges by what a search has found, beyond how a ``lost`` state has them.

    ``scales`` are ln of how much longer, by s sensors, and ``covariance`` (6 + s, 6 + s) is the
    pose's, in the world, and theirs: they have been found together.
    """
    calibration, entries = state.calibration, []
    if SCALE not in calibration.of_sensor:
        return
    for frame, scale in scales.items():
        state.gains.calibrate(frame)
        change = np.zeros(calibration.count)
        now = math.log(sensor_values(lost, frame)[2]) + scale
        change[calibration.columns(frame)] = np.where(
            calibration.of_sensor == SCALE, now - calibration.sensor(frame)[SCALE], 0.0
        )
        calibration.shift(change)
        state.relinearisation.add_calibration()
        (own,) = np.flatnonzero(calibration.of_sensor == SCALE).tolist()
        entries.append(calibration.columns(frame).start + own)
    # Their errors are G times the pose's, and others.
    pose, observer = state.axes.pose, state.observer
    with_pose, to_world = covariance[6:, pose], turn_to_world(observer, observer.A)[pose, pose]
    G = np.linalg.solve(covariance[pose, pose], with_pose.T).T
    others = covariance[6:, 6:] - G @ with_pose.T
    state.known_errors.joint.relate(state.axes.p + np.array(entries), G @ to_world, others)


def _completed(
    state: State, event: ObservationEvent, rows: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lines of sight (m, 3) as a sensor would have shown them, and their covariances.

    And along which directions (m, 3, 3) they are measured. Of landmarks that are not known, with
    what was measured alone.
    """
    shown, expected = event.lines_of_sight, event.lines_of_sight.copy()
    known = rows >= 0
    if known.any():
        expected[known] = expected_lines(state, event.select(known), rows[known])
    kinds = of_axes(event.kinds, state)
    lines = completed_lines(shown, expected, kinds)
    whole = kinds == POINT
    expected[whole] = lines[whole]
    return lines, *_covariances(state, event, expected, kinds)


def of_axes(kinds: IntArray | None, state: State) -> IntArray:
    """Return kinds as they are in the plane, too, where an azimuth is a whole direction."""
    whole = {AZIMUTH: BEARING, AZIMUTH_RANGE: POINT} if state.axes.is_planar else {}
    all_kinds = np.asarray(kinds)
    for azimuth, kind in whole.items():
        all_kinds = np.where(all_kinds == azimuth, kind, all_kinds)
    return all_kinds


def expected_lines(state: State, event: ObservationEvent, rows: IntArray) -> FloatArray:
    """Return how a sensor would show landmarks ``rows`` (m,), by its calibration, body axes."""
    R, shift, scale = sensor_values(state, event.sensor_frame)
    origins = event.points - event.lines_of_sight + shift
    lines = state.observer.body_points(rows) - origins
    if state.axes.is_planar:
        lines[:, 2] = 0.0
    shown: FloatArray = lines @ R / scale
    if state.calibration.range_bias_m:
        is_range = np.isin(np.asarray(event.kinds), RANGES)
        biases, _ = state.calibration.biases(np.where(is_range, event.ids, -1))
        shown = without_bias(shown, -biases) * shown
    return shown


def _covariances(
    state: State, event: ObservationEvent, lines: FloatArray, kinds: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return covariances (m, 3, 3) about expected lines of sight (m, 3), and what is measured."""
    noise = state.observation_noise
    modelled = point_covariances(lines, noise.figures)
    basis, lengths = directions_of(lines), np.linalg.norm(lines, axis=1)
    variances = np.einsum('mij,mjk,mik->mi', basis, modelled, basis)
    stated = event.covariances
    if stated is not None:
        own = directions_of(event.lines_of_sight)
        of_shown = np.einsum('mij,mjk,mik->mi', own, stated, own)
        # What is stated of a unit vector is an angle.
        is_unit = ~MEASURED[kinds][:, 0]
        of_shown[is_unit, 1:] *= lengths[is_unit, None] ** 2
        is_stated = stated.any(axis=(1, 2))
        variances[is_stated] = of_shown[is_stated]
    is_measured = measured_axes(event.lines_of_sight, lines, kinds)
    variances = np.where(is_measured, variances, 0.0)
    covariances: FloatArray = np.einsum('mij,mi,mik->mjk', basis, variances, basis)
    directions = is_measured[:, :, None] * basis
    directions[kinds == POINT] = np.eye(3)
    if stated is not None:
        whole = (kinds == POINT) & stated.any(axis=(1, 2))
        covariances[whole] = stated[whole]
    return covariances, directions
