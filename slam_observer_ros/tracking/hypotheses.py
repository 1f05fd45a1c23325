"""Hypotheses: states that take what was seen for different things (:mod:`.interpretations`).

Where two interpretations of an observation put the robot at different poses, both are followed,
each with a state of its own, until later observations have made one much more likely than the
other (D. B. Reid, *An algorithm for tracking multiple targets*, 1979). So are two that take the
points for different landmarks at the same pose: their maps differ. Where landmarks have ids or are
well separated there is nearly always one hypothesis.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
import math

import numpy as np

from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID, FloatArray, IntArray, is_automatic
from slam_observer_ros.estimates import (
    Ambiguity,
    CalibrationEstimate,
    Change,
    DELAY_NAME,
    Outcome,
    Outcomes,
    Reason,
    Update,
)
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import cholesky, mahalanobis, squares_and_log_dets, transpose
from slam_observer_ros.models.velocity_delay import DelayEvidence
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.smoothing.relinearisation import MAX_TURN_RAD, SHARE_OF_HISTORY
from slam_observer_ros.tracking.costs import NewLandmarks
from slam_observer_ros.tracking.covariances import of_pose
from slam_observer_ros.tracking.hypothesis import Branch, Hypothesis, IdPairs, Twins
from slam_observer_ros.tracking.interpretations import (
    Interpretation,
    interpretations,
    may_name,
)
from slam_observer_ros.tracking.joint_compatibility import (
    pruning_cost,
    PRUNING_COST_OF_IDS,
    RESOLUTION,
    unpaired_cost,
)
from slam_observer_ros.tracking.slip import MapViews, Slip, Standing
from slam_observer_ros.tracking.state import Association, State

AMBIGUOUS = 4.0
"""Deviation of the pose by all hypotheses, over what the best one states, in any direction, from
which on they are several maps and not one.
"""

AMBIGUOUS_NS = 5_000_000_000
"""How long that has to last, nanoseconds: what the next views decide is no news."""

DOUBTED = 0.05
"""Probability from which on another map of a landmark is named beside that which is shown."""

DOUBTED_COST = 2.0 * math.log(1.0 / DOUBTED - 1.0)
"""How much more than the likeliest a map of that probability costs."""

LEAST_DEVIATION = 0.01
"""Deviation of a pose, rad and m, within which poses are the same."""

OVERTHROWN = 4.0
"""Normalised square, per axis, of how far a map was off from which on it was wrong: 2 σ in all."""

COMPARED = 16
"""Landmarks by which two maps are compared, those seen last: time grows with their cube."""


@dataclass(frozen=True, slots=True)
class _Child:
    """A hypothesis after an observation, the meaning that it took it in, and what that did."""

    hypothesis: Hypothesis
    parent: int  # number of the hypothesis that it was before
    event: ObservationEvent
    update: Update
    known: KnownMap


class KnownMap:
    """The landmarks of a state, as they are compared with another one's."""

    def __init__(self, state: State) -> None:
        ids = state.landmarks.ids
        self.state, self.ids = state, frozenset(ids.tolist())
        self.sure = frozenset(ids[~state.landmarks.tentative].tolist())  # these surely exist
        self.are_own = bool(is_automatic(ids).all())  # the sensor gave no id to any of them

    @cached_property
    def points(self) -> FloatArray:
        """(n, 3) where they should be seen, metres, body frame."""
        return self.state.observer.body_points(np.arange(len(self.state.landmarks)))

    @cached_property
    def _covariances(self) -> FloatArray:
        """(n, k, k) of a view of each, reference frame, m²."""
        state, n = self.state, len(self.points)
        noise, rows = state.observation_noise.at(self.points), np.arange(n)
        residuals = state.gains.residuals(rows, self.points, noise, np.zeros(n), np.ones(n))
        return state.known_errors.own_innovation_covariances(residuals)

    def distances(self, rows: IntArray, other: KnownMap, others: IntArray) -> FloatArray:
        """Return how far from landmarks (m,) another state has its ``others``, in σ of a view."""
        off = (other.points[others] - self.points[rows]).dot(self.state.observer.A[:3, :3].T)
        S = self._covariances[rows]
        return np.asarray(np.sqrt(squares_and_log_dets(S, off[:, : S.shape[2]])[0]))


class Hypotheses:
    """Hypotheses about pose and map, the most likely first; at the start there is one."""

    best: State  # the most likely one
    update: Update  # what the last observation did to it

    def __init__(self, state: State) -> None:
        self._earlier_counts = Outcomes()
        self._start(state)

    def reset(self, state: State) -> None:
        """Replace all hypotheses by a new one."""
        self._earlier_counts.add(self.best.counts)
        self._start(state)

    def _start(self, state: State) -> None:
        self._go_on_with([Hypothesis.of(state)])
        # Else points have ids, and are what these say.
        self._can_weigh = state.errors is not None
        self._limit = state.settings.max_hypotheses
        self._next_id = FIRST_AUTOMATIC_ID
        self._some_have_ids = False
        # Observations so far, and how many at which hypotheses are weighed by their past again
        self._observations, self._weighed_next = 0, 0.0
        self._new_landmarks = NewLandmarks()
        self.standing = Standing()  # whether wheels spin, and what the robot carries along
        self._views: MapViews | None = None  # where the robot is in a map
        self._velocities: VelocityHistory | None = None  # along which they were moved
        self._delay_evidence = DelayEvidence()
        self._present: Ambiguity | None = None
        self._longest: Ambiguity | None = None

    def _go_on_with(self, hypotheses: list[Hypothesis]) -> None:
        self._all, self.best = hypotheses, hypotheses[0].state

    @property
    def ambiguity(self) -> Ambiguity | None:
        """Since when what is seen fits several maps; None if it does not, or only for a moment."""
        return _lasting(self._present)

    @property
    def longest_ambiguity(self) -> Ambiguity | None:
        """The longest time in which it did, since the start."""
        return _lasting(self._longest)

    @property
    def counts(self) -> Counter[str]:
        """Outcomes for landmarks, in the most likely state and those given up by resets."""
        return self._earlier_counts + self.best.counts

    @property
    def outcomes(self) -> list[Outcome]:
        """What became of points and landmarks, as :attr:`counts` counts it, if that was kept."""
        return self._earlier_counts.each + self.best.counts.each

    def some_counts(self, names: Iterable[str]) -> list[int]:
        """Return some of the :attr:`counts`, without adding up all of them."""
        earlier, counts = self._earlier_counts, self.best.counts
        return [earlier.get(name, 0) + counts.get(name, 0) for name in names]

    def __len__(self) -> int:
        """Return how many hypotheses there are."""
        return len(self._all)

    @property
    def states(self) -> list[State]:
        """All states, the most likely one first."""
        return [hypothesis.state for hypothesis in self._all]

    @property
    def missed(self) -> float:
        """Landmarks that should have been among the points without ids seen last, and were not."""
        return self._all[0].visibility.missed

    def prune_to_best(self) -> State:
        """Give up all hypotheses but the most likely one, and return its state."""
        self._views = None
        self._go_on_with(self._all[:1])
        return self.best

    def fork(self, find: Callable[[State, Set[IdPairs]], list[Twins]]) -> None:
        """Take landmarks for one that are likely to be; follow each answer that may be right.

        ``find`` returns these of a state, but for those that were asked before.
        """
        before, shown = len(self._all), self._all[0]
        for hypothesis in list(self._all):
            gate = hypothesis.state.settings.rejection_threshold
            ways = find(hypothesis.state, hypothesis.asked)
            while any(len(way.rows) for way in ways):
                ids, followed = hypothesis.state.landmarks.ids, [hypothesis]
                asked = hypothesis.asked.union(*(way.asked(ids) for way in ways))
                others = [hypothesis.copy() for _ in ways[1:]]
                for one, way in zip((hypothesis, *others), ways, strict=True):
                    # Of three that are one, two at first; each per axis at the gate.
                    first, one.asked = ~np.isin(way.rows, way.copies), asked
                    rows, copies = way.rows[first], way.copies[first]
                    most = (way.width * gate) ** 2 / one.state.axes.point
                    seen_cost, costs = one.state.landmarks.seen_cost, way.seen_costs[first]
                    seen_cost[copies] += costs
                    if len(rows) and one.state.merge(rows, copies, most) > most:
                        seen_cost[copies] -= costs
                        continue
                    one.cost += way.cost
                    if one is not hypothesis:
                        followed.append(one)
                if len(followed) > 1:
                    _part(followed, int(hypothesis.state.landmarks.last_seen_ns.max()))
                    self._all += followed[1:]
                ways = find(hypothesis.state, hypothesis.asked)
        if len(self._all) > before or self._observations >= self._weighed_next:
            self._weighed_next = (1.0 + SHARE_OF_HISTORY) * self._observations
            _weigh_again(self._all)
        self._go_on_with(sorted(self._all, key=lambda one: one.cost)[: self._limit])
        least_cost = self._all[0].cost
        for hypothesis in self._all:
            hypothesis.cost -= least_cost
        if self._all[0] is not shown:
            stamp_ns = int(shown.state.landmarks.last_seen_ns.max(initial=0))
            self._note_overthrow(shown, shown.path, stamp_ns)

    def pose_after(
        self, velocities: VelocityHistory, start_ns: int, end_ns: int
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the most likely pose (4, 4) at ``end_ns``, and its covariance (6, 6) if known.

        Hypotheses are moved on from ``start_ns``, and the most likely one may be wrong.
        """
        known = [velocities.flat()]
        of_each = [state.poses_until(known, start_ns, [end_ns]) for state in self.states]
        covariance = self._mixed(of_each)
        return of_each[0][0][0], None if covariance is None else covariance[0]

    def poses_until(
        self,
        velocities: VelocityHistory,
        start_ns: int,
        stamps_ns: IntArray,
        with_covariances: bool,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the most likely poses (s, 4, 4) at stamps (s,), and their covariances (s, 6, 6).

        As :meth:`.State.poses_until` of each hypothesis, along velocities known then.
        """
        known, stamps = velocities.flat_then(stamps_ns), stamps_ns.tolist()
        states = self.states if with_covariances else [self.best]
        of_each = [state.poses_until(known, start_ns, stamps) for state in states]
        return of_each[0][0], self._mixed(of_each) if with_covariances else None

    def _mixed(self, of_each: Sequence[tuple[FloatArray, FloatArray | None]]) -> FloatArray | None:
        """Return the covariance (…, 6, 6) of the first pose (…, 4, 4), by all hypotheses.

        It is Σ w_i (P_i + d_i d_iᵀ), with w_i their likelihoods, and d_i how far their poses are
        from the first one, in the coordinates of :meth:`.State.pose_after`.
        """
        pose, own = of_each[0]
        if len(of_each) == 1:  # as nearly always
            return own
        weights, total = self.weights, own
        for (other, covariance), weight in zip(of_each[1:], weights[1:].tolist(), strict=True):
            if total is None or own is None or covariance is None:
                return None
            d = _difference(pose, other)
            total = total + weight * (covariance - own + d[..., :, None] * d[..., None, :])
        return total

    @property
    def weights(self) -> FloatArray:
        """Probabilities (h,) of the hypotheses, as far as one of them is right."""
        likelihoods = np.exp(-0.5 * np.array([hypothesis.cost for hypothesis in self._all]))
        return np.asarray(likelihoods / likelihoods.sum())

    def configuration_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the joint covariance (m k, m k) of landmarks of the best map, seen by the robot.

        As :meth:`.State.configuration_covariance`, about that map and by all hypotheses. Of a
        landmark that one of them has not, that one says nothing.
        """
        best, k = self.best, self.best.axes.point
        own = best.configuration_covariance(rows)
        if own is None or len(self._all) == 1:
            return own
        ids, points = best.landmarks.ids[rows], best.observer.body_points(rows)
        mixed, left = np.zeros_like(own), np.ones(len(own))
        for hypothesis, weight in zip(self._all[1:], self.weights[1:].tolist(), strict=True):
            state = hypothesis.state
            others = state.landmarks.rows_of(ids)
            known, others = others >= 0, others[others >= 0]
            covariance = state.configuration_covariance(others)
            if covariance is None:
                return None
            at = np.flatnonzero(np.repeat(known, k))
            d = (state.observer.body_points(others) - points[known])[:, :k].ravel()
            mixed[np.ix_(at, at)] += weight * (covariance + np.outer(d, d))
            left[at] -= weight
        shares = np.sqrt(left)
        return shares[:, None] * own * shares + mixed

    def propagate(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move all hypotheses on from ``start_ns``, where they are, to ``end_ns`` (27)."""
        stood_s, flat = velocities.stood_s(end_ns), velocities.flat()
        at_rest, velocities.at_rest.means = velocities.at_rest.means, []
        for hypothesis in self._all:
            state = hypothesis.state
            state.observation_noise.stood_s = stood_s
            for rate, rate_variances in at_rest:
                state.learn_at_rest(rate, rate_variances)
            before = state.observer.A.copy()
            variances = state.advance(flat, start_ns, end_ns)
            if state is not self.best:
                continue
            standing = self.standing
            standing.before, standing.pose = (
                standing.pose,
                standing.pose.dot(se3.between(before, state.observer.A)),
            )
            calibration = state.calibration
            if calibration.delay_error_ns:
                self._delay_evidence.add(flat, calibration, variances, start_ns, end_ns)
        self._velocities = velocities

    @property
    def calibration(self) -> list[CalibrationEstimate]:
        """Scale, bias and delay of the velocity in the most likely state."""
        best, initial_s = self.best, self.best.settings.velocity_delay_stddev
        return [
            self._delay_evidence.corrected(part, initial_s) if part.name == DELAY_NAME else part
            for part in best.calibration.estimates(best.gains.calibration_variances)
        ]

    def clear_time(self) -> None:
        """Let all hypotheses go on from where they are at any other time."""
        self._present = None
        for hypothesis in self._all:
            hypothesis.state.clear_time()
        self.standing.clear_time()
        self._views = None

    def forget(self, landmark_id: int) -> bool:
        """Remove a landmark from all maps; return whether the most likely one had it."""
        states = self.states
        rows = [state.landmarks.rows_of(np.array([landmark_id])) for state in states]
        for state, row in zip(states, rows, strict=True):
            if row[0] >= 0:
                state.remove(row)
        return bool(rows[0][0] >= 0)

    @property
    def slips(self) -> bool:
        """Whether the wheels slip now."""
        return self.standing.slip is not None

    def judge_slip(self, event: ObservationEvent) -> ObservationEvent:
        """Stop where the wheels spin; return an observation without landmarks that are carried."""
        standing, best = self.standing, self.best
        is_due = event.stamp_ns >= standing.due_ns or event.sensor_frame != standing.sensor_frame
        if is_due and self._can_weigh and self._velocities is not None:
            were_carried = standing.carried
            if (slip := standing.note(best, event, self._velocities)) is not None:
                self._take(slip)
            if newly := standing.carried - were_carried:
                for state in self.states:
                    state.counts.note(Change.CARRIED, np.array(sorted(newly)), event.stamp_ns)
            if best.is_mapping:
                for landmark_id in newly:
                    self.forget(landmark_id)
        if standing.excluded:
            is_carried = np.isin(event.ids, list(standing.excluded))
            for hypothesis in self._all:
                counts = hypothesis.state.counts
                counts.note(Reason.CARRIED, event.ids[is_carried], event.stamp_ns)
            event = event.select(~is_carried)
        return event

    def judge_views(self, ids: IntArray, covariances: FloatArray | None) -> bool:
        """Let the pose be less sure where views of a map contradict it; return whether they do.

        Landmarks ``ids`` (n,) are in the map, with ``covariances`` (n, 3, 3) or none.
        """
        if self._views is None and self._can_weigh:
            self._views = MapViews(self.best.axes, ids, covariances)
        if self._views is None or (slip := self._views.contradiction(self.best)) is None:
            return False
        self._take(slip)
        return True

    def _note_ambiguity(self, event: ObservationEvent) -> None:
        """Note whether points without ids fit several maps, after an observation."""
        are_several = len(self._all) > 1 and bool((event.ids == UNKNOWN_ID).any())
        if not are_several or self._disagreement() <= AMBIGUOUS:
            self._present = None
            return
        stamp_ns, probability = event.stamp_ns, float(self.weights[0])
        present = self._present
        if present is None:
            position = self.best.observer.pose[:3, 3].copy()
            present = Ambiguity(stamp_ns, stamp_ns, position, 1.0, np.empty(0, dtype=np.int64))
        if probability < present.probability:
            present = replace(present, probability=probability, ids=self._doubted())
        self._present = present = replace(present, until_ns=stamp_ns)
        if self._longest is None or present.lasts_ns > self._longest.lasts_ns:
            self._longest = present

    def _doubted(self) -> IntArray:
        """Return landmarks that likely hypotheses have elsewhere than the best, or have not."""
        best, known = self.best, KnownMap(self.best)
        probabilities = np.zeros(len(best.landmarks))
        for hypothesis, weight in zip(self._all[1:], self.weights[1:].tolist(), strict=True):
            probabilities[_different(known, KnownMap(hypothesis.state))] += weight
        return best.landmarks.ids[probabilities > DOUBTED]

    def _note_overthrow(self, shown: Hypothesis, path: Sequence[Branch], stamp_ns: int) -> None:
        """Note since when a map was wrong that was shown, and is not the most likely one now."""
        best = self._all[0]
        ways = zip(path, best.path, strict=False)
        since = next((old for old, new in ways if old.number != new.number), None)
        if since is None or _off(best.state, shown.state) <= OVERTHROWN:
            return
        probability = 1.0 / (1.0 + math.exp(0.5 * min(max(shown.cost, 0.0), PRUNING_COST_OF_IDS)))
        different = _different(KnownMap(best.state), KnownMap(shown.state))
        ids = best.state.landmarks.ids[different]
        wrong = Ambiguity(since.stamp_ns, stamp_ns, since.position, probability, ids)
        if self._longest is None or wrong.lasts_ns > self._longest.lasts_ns:
            self._longest = wrong

    def _disagreement(self) -> float:
        """Return the pose's deviation by all hypotheses over that by the best one, at most."""
        states, observer, pose = self.states, self.best.observer, self.best.axes.pose
        # All at once: they have one reference frame.
        of_errors = np.array([state.known_errors.pose_covariance() for state in states])
        A = np.array([state.observer.A for state in states])
        covariances = of_pose(observer, of_errors, A)[:, pose, pose]
        poses = observer.reference_pose @ A
        d = _difference(poses[0], poses)[:, pose]
        moments = covariances + d[:, :, None] * d[:, None, :]
        least = LEAST_DEVIATION**2 * np.eye(len(d[0]))
        L = np.linalg.inv(cholesky(covariances[0] + least))
        spread = L @ (np.tensordot(self.weights, moments, 1) + least) @ L.T
        return float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))

    def _take(self, slip: Slip) -> None:
        """Let all hypotheses slip."""
        for state in self.states:
            state.slip(state.observer.A @ slip.motion, slip.covariance)
            state.counts['slip'] += slip.is_new

    def associate(self, event: ObservationEvent) -> Iterator[Association]:
        """Yield states with the landmarks that points are of; those that are updated remain.

        Nearly always there is one state, and ids say which landmark is which. Points without ids,
        and some that the gate mostly rejects, may mean several things; then each way is yielded.
        """
        unknown = int(np.count_nonzero(event.ids == UNKNOWN_ID))
        self._some_have_ids = self._some_have_ids or unknown < len(event.ids)
        self._observations += 1
        best = self.best
        some_may_be_named = best.landmarks.some_without_ids and may_name(best, event.ids)
        is_clear = len(self._all) == 1 and not unknown and not some_may_be_named
        if is_clear or not self._can_weigh:
            if self._views is not None:
                self._views.add(best, event)
            may_refuse = self._can_weigh and self._limit > 1
            rows = best.landmarks.rows_of(event.ids)
            yield (one := Association(best, event, rows, may_refuse))
            if not one.is_refused:
                self.update, self._present = one.update, None
                return
        # All hypotheses with all meanings; costs are differences to the most likely one.
        possible = self._interpret(event)
        number, likeliest = possible[0]
        if self._views is not None and not number and likeliest.slipped is None:
            self._views.add(best, likeliest.event)
        shown, children = self._all[0], list[_Child]()
        yield from self._follow(event, possible, children)
        children.sort(key=lambda child: child.hypothesis.cost)
        if unknown and children[0].parent:  # another map would be shown
            _weigh_again([child.hypothesis for child in children])
            children.sort(key=lambda child: child.hypothesis.cost)
        self.update, least_cost = children[0].update, children[0].hypothesis.cost
        self._go_on_with([child.hypothesis for child in children])
        for hypothesis in self._all:
            hypothesis.cost -= least_cost
        if unknown and children[0].parent:
            still = [child.hypothesis for child in children if not child.parent]
            if not still:  # it is given up at once
                shown.cost += pruning_cost(event.ids)
            self._note_overthrow((still or [shown])[0], shown.path, event.stamp_ns)
        # A way that all of them went sets none of them apart.
        paths = [hypothesis.path for hypothesis in self._all]
        if common := len(_common(paths)):
            for hypothesis in self._all:
                hypothesis.path = hypothesis.path[common:]
        if unknown:
            visibility = self._all[0].visibility
            visibility.field_of_view.include(likeliest.event.points)
            self._new_landmarks.note(event, visibility.sure_now + visibility.false_now)
        self._note_ambiguity(event)

    def _follow(
        self,
        event: ObservationEvent,
        possible: list[tuple[int, Interpretation]],
        children: list[_Child],
    ) -> Iterator[Association]:
        """Yield each interpretation of an observation; append ``children`` as they come."""
        # A state is copied for each use of it but the last.
        uses = Counter(number for number, taken in possible if taken.slipped is None)
        for number, taken in possible:
            hypothesis = self._all[number]
            if taken.slipped is not None:
                hypothesis = hypothesis.with_state(taken.slipped)
            else:
                uses[number] -= 1
                if uses[number]:
                    hypothesis = hypothesis.copy()
            state = hypothesis.state
            if len(taken.named_rows):
                state.landmarks.renumber(taken.named_rows, taken.given_ids)
            rows = state.landmarks.rows_of(taken.event.ids)
            named = taken.event
            if named.points is not event.points:  # calibrated, which the step does itself
                named = replace(event, ids=named.ids)
            yield (one := Association(state, named, rows))
            self._weigh(hypothesis, taken, event)
            # Of hypotheses that become one, the first stands for all.
            child = _Child(hypothesis, number, taken.event, one.update, KnownMap(state))
            if not any(_are_one(child, other) for other in children):
                children.append(child)
            if len(children) == self._limit:
                break
        for number, count in Counter(child.parent for child in children).items():
            if count > 1:
                same = (child.hypothesis for child in children if child.parent == number)
                _part(same, event.stamp_ns)

    def _weigh(
        self, hypothesis: Hypothesis, taken: Interpretation, event: ObservationEvent
    ) -> None:
        """Let a hypothesis, which took an observation in a way, cost what that is unlikely."""
        hypothesis.cost, state = taken.cost, hypothesis.state
        if (event.ids == UNKNOWN_ID).any():
            visibility, ids = hypothesis.visibility, taken.event.ids
            if taken.evidence is not None:
                rows = state.landmarks.rows_of(ids)
                if taken.seen_costs is not None:
                    state.landmarks.seen_cost[rows[rows >= 0]] += taken.seen_costs[rows >= 0]
                visibility.sure_now = state.landmarks.weigh(
                    rows[rows >= 0], taken.evidence[rows >= 0]
                )
            hypothesis.cost += visibility.note(state, taken.event, self._some_have_ids)

    def _interpret(self, event: ObservationEvent) -> list[tuple[int, Interpretation]]:
        """Return the interpretations by each hypothesis, by its number, the cheapest first.

        Their costs include the hypothesis's own. A point that is taken for a new landmark has
        the same id in all of them.
        """
        new_ids, margin = self._new_ids(len(event.ids)), pruning_cost(event.ids)
        gate_cost, k = unpaired_cost(self.best.settings.rejection_threshold), self.best.axes.point
        noise = self.best.observation_noise.covariances(event)[:, :k, :k]
        volume = self._all[0].visibility.field_of_view.volume
        new_costs = self._new_landmarks.costs(noise, volume, gate_cost)
        if self._some_have_ids:  # which say more about new ground
            new_costs = replace(new_costs, steps=np.zeros(len(noise)))
        is_alone = len(self._all) == 1
        possible: list[tuple[int, Interpretation]] = []
        worst = math.inf  # the most that is worth following, the cheapest so far being known
        for number, hypothesis in enumerate(self._all):
            cost, state = hypothesis.cost, hypothesis.state
            budget = worst - cost
            for taken in interpretations(state, event, new_ids, new_costs, budget, is_alone):
                taken.cost += cost
                possible.append((number, taken))
                worst = min(worst, taken.cost + margin)
        possible.sort(key=lambda pair: pair[1].cost)
        return [(number, taken) for number, taken in possible if taken.cost <= worst]

    def _new_ids(self, m: int) -> IntArray:
        """Return ids (m,) that no landmark of any hypothesis has, nor one of a loaded map."""
        for hypothesis in self._all:
            ids = hypothesis.state.landmarks.ids
            self._next_id = max(self._next_id, int(np.max(ids[is_automatic(ids)], initial=0)) + 1)
        return self._next_id + np.arange(m)


def _part(hypotheses: Iterable[Hypothesis], stamp_ns: int) -> None:
    """Note that each goes another way than the others from now on."""
    for number, hypothesis in enumerate(hypotheses):
        position = hypothesis.state.observer.pose[:3, 3].copy()
        hypothesis.path = (*hypothesis.path, Branch(number, stamp_ns, position))


def _weigh_again(hypotheses: Sequence[Hypothesis]) -> None:
    """Let hypotheses cost what all that was seen costs by their own past, relinearised."""
    # What a slip costs is set, and no likelihood.
    if len(hypotheses) == 1 or len({one.state.counts['slip'] for one in hypotheses}) > 1:
        return
    of_poses = [one.state.known_errors.pose_covariance() for one in hypotheses]
    if max(float(np.trace(each[:3, :3])) for each in of_poses) <= MAX_TURN_RAD**2:
        return
    evidence = [one.state.relinearisation.evidence() for one in hypotheses]
    known = [each for each in evidence if each is not None]
    if len(known) < len(hypotheses):
        return
    for one, each in zip(hypotheses, known, strict=True):
        before = one.relinearised
        one.relinearised = each - float(one.state.landmarks.seen_cost.sum())
        one.cost += one.relinearised - before


def _common(paths: Sequence[Sequence[Branch]]) -> list[Branch]:
    """Return the ways that all paths begin with."""
    steps = zip(*paths, strict=False)
    same = takewhile(lambda each: len({(one.stamp_ns, one.number) for one in each}) == 1, steps)
    return [each[0] for each in same]


def _off(state: State, other: State) -> float:
    """Return the normalised square, per axis, of how far a state has the landmarks of another.

    As the robot sees those seen last, by how well the other one knows where they are.
    """
    rows = other.confirmed
    rows = rows[np.argsort(-other.landmarks.last_seen_ns[rows], kind='stable')]
    own = state.landmarks.rows_of(other.landmarks.ids[rows])
    rows, own = rows[own >= 0][:COMPARED], own[own >= 0][:COMPARED]
    covariance, k = other.configuration_covariance(rows), other.axes.point
    if covariance is None or not len(rows):
        return 0.0
    d = (state.observer.body_points(own) - other.observer.body_points(rows))[:, :k].ravel()
    z = np.linalg.solve(cholesky(covariance + LEAST_DEVIATION**2 * np.eye(len(d))), d)
    return float(z @ z / len(z))


def _lasting(ambiguity: Ambiguity | None) -> Ambiguity | None:
    lasts = ambiguity is not None and ambiguity.lasts_ns >= AMBIGUOUS_NS
    return ambiguity if lasts else None


def _are_one(child: _Child, other: _Child) -> bool:
    state, other_state = child.hypothesis.state, other.hypothesis.state
    if child.known.are_own:
        is_unlikely = child.hypothesis.cost >= other.hypothesis.cost + DOUBTED_COST
        return have_one_map(child.known, other.known, is_unlikely)
    return are_one(state, child.event, other_state, other.event)  # else ids will show


def have_one_map(known: KnownMap, others_known: KnownMap, is_unlikely: bool = False) -> bool:
    """Return whether two hypotheses have the same landmarks at the same places about the robot.

    By how well either of them knows where they are, and the sensor would see them: no observation
    to come will show then which of them is right. Where one of them has a landmark that the other
    has not, that is yet to be confirmed. Or the first ``is_unlikely``, and the other one has
    another landmark there: of one that is doubled, :meth:`Hypotheses.fork` asks time and again.
    """
    more, others_more = known.sure - others_known.ids, others_known.sure - known.ids
    if (more or others_more) and not (is_unlikely and known.ids and others_known.ids):
        return False
    # The other one is compared more often, and has what it expects at hand.
    return _agree(others_known, others_more, known) and _agree(known, more, others_known)


def _agree(known: KnownMap, more: Set[int], others_known: KnownMap) -> bool:
    """Return whether a state expects landmarks of both where another one has them.

    And each of ``more`` where that one has any.
    """
    landmarks = known.state.landmarks
    rows = landmarks.rows_of(others_known.state.landmarks.ids)
    others = np.flatnonzero(rows >= 0)
    rows = rows[others]
    if more:
        added = landmarks.rows_of(np.array([*more], dtype=np.int64))
        off = known.points[added][:, None] - others_known.points
        nearest = np.einsum('ijk,ijk->ij', off, off).argmin(axis=1)
        rows, others = np.append(rows, added), np.append(others, nearest)
    return bool((known.distances(rows, others_known, others) <= RESOLUTION).all())


def _different(known: KnownMap, others_known: KnownMap) -> IntArray:
    """Return rows of confirmed landmarks that another state has elsewhere, or has not."""
    rows = known.state.confirmed
    others = others_known.state.landmarks.rows_of(known.state.landmarks.ids[rows])
    off, is_known = others < 0, others >= 0
    off[is_known] = known.distances(rows[is_known], others_known, others[is_known]) > RESOLUTION
    return rows[off]


def _difference(pose: FloatArray, other: FloatArray) -> FloatArray:
    """Return rotation vector and shift (…, 6) from one pose to another, along the world's axes."""
    turn = so3.log(other[..., :3, :3] @ transpose(pose[..., :3, :3]))
    return np.concatenate([turn, other[..., :3, 3] - pose[..., :3, 3]], axis=-1)


def are_one(
    state: State, event: ObservationEvent, other: State, other_event: ObservationEvent
) -> bool:
    """Return whether two hypotheses, by the points seen, have one pose and one map there.

    They have if the points, and each landmark that either takes one of them for, have the same
    positions: which was which in this observation does not matter then.
    """
    # How far the points seen are from each other, and the landmarks they are taken for.
    here, there = state.observer.pose, other.observer.pose
    noise = here[:3, :3] @ state.observation_noise.covariances(event) @ here[:3, :3].T
    shifts = [se3.transform(here, event.points) - se3.transform(there, event.points)]
    if not np.array_equal(event.ids, other_event.ids):
        for ids in (event.ids, other_event.ids):
            rows, other_rows = state.landmarks.rows_of(ids), other.landmarks.rows_of(ids)
            if (rows < 0).any() or (other_rows < 0).any():
                return False
            own, others = state.observer.world_points, other.observer.world_points
            shifts.append(own[rows] - others[other_rows])
    distances = mahalanobis(np.concatenate(shifts), np.tile(noise, (len(shifts), 1, 1)))
    return len(distances) > 0 and bool(np.max(distances) <= RESOLUTION)
