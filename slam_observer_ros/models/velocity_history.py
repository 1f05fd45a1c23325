"""Velocities of the recent past, of one or two sensors, each held until the next one."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, fields, replace
import math
from statistics import median_low

import numpy as np

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import (
    AngularVelocityEvent,
    flatten_velocities,
    MeasuredVelocity,
    VelocityBlock,
    VelocityEvent,
)
from slam_observer_ros.models.held_velocities import held, HeldVelocities, lead, Velocities

NEVER_NS = -10_000 * NANOSECONDS_PER_SECOND  # before time began

# The last 16 times 64 periods show how long messages of a sensor are in force as a rule. So many
# that they have pauses in them where these are usual, as of commands.
BLOCK, BLOCKS = 64, 16
FEWEST_PERIODS = 5  # periods that show how often messages come: a pause or two change nothing

# How long a velocity must have been exactly zero before the robot stands, nanoseconds. Commands
# are ahead of the robot by their delay, and it coasts; both take less than that.
STANDS_NS = NANOSECONDS_PER_SECOND

# Angular velocity, less the bias at rest, beyond which the robot turns, rad/s. No bias is larger;
# the noise of a MEMS gyroscope's reading is a third as large.
TURNS = 0.03

# Standard deviation of a gyroscope's bias that no average makes less, rad/s: 20° an hour. The
# instability of a MEMS gyroscope, by data sheets; a robot that stands turns by less, too.
INSTABILITY = 1e-4

# (6, 6) covariance of the velocity of a robot that stands, rad²/s² and m²/s²: next to none. In
# eight hours, with twenty messages a second, it drifts by 4 mm. With much less, what links two
# observations would weigh so much that smoothing had no digits left for what is seen.
STANDING = 1e-4**2 * np.eye(6)
FIRST_CAPACITY = 64  # velocities that there is room for at first


class VelocityHistory:
    """Velocities in stamp order, joined with the angular velocities of another sensor.

    A velocity is held for ``timeout_ns`` at most. Where the other sensor's angular one was older
    when it came, the velocity's own counts; with ``is_planar``, only parts in the plane z = 0.
    """

    def __init__(
        self, timeout_ns: int, is_planar: bool = False, bias: FloatArray | None = None
    ) -> None:
        self._timeout_ns, self._is_planar = timeout_ns, is_planar
        # In force from each stamp to the next; the first one is in force before any event.
        self._joined, self._count = _Joined.with_room_for(FIRST_CAPACITY), 1
        self._angular: AngularVelocityEvent | None = None
        self._periods, self._angular_periods = _Periods(), _Periods()
        self._zero_since_ns: int | None = None  # since when the velocity has been exactly zero
        self._last_zero_ns = NEVER_NS
        # Who has no odometry may publish zeros, and state how the robot may move as their noise.
        self._has_moved = False
        self._stands = False
        # About which axes turns count.
        self._counts = np.array([0.0, 0.0, 1.0]) if is_planar else np.ones(3)
        self.at_rest = _AtRest(self._counts * (np.zeros(3) if bias is None else -bias))

    def append(self, measured: MeasuredVelocity) -> bool:
        """Add later velocities; return if in force: angular ones wait for the first linear one."""
        stand: list[int] = []  # which of the new ones are of a robot that stands
        if isinstance(measured, AngularVelocityEvent):
            self._angular_periods.add(measured.stamp_ns)
            self._angular = measured
            if self._zero_since_ns is not None:
                stood_ns = measured.stamp_ns - self._zero_since_ns
                self.at_rest.add(stood_ns, self._counts * measured.angular_velocity)
            if self._count == 1:
                return False
            first = self._new_row(1)
            self._joined.repeat_last(first, measured.stamp_ns)
            self._joined.usual_s[first, 1] = self._periods.usual_s
            stand = [first] * self._stands
        elif isinstance(measured, VelocityEvent):
            first, one, usual_s = self._new_row(1), measured, self._took(measured)
            self._joined.write(first, one.stamp_ns, one.body_velocity, one.covariance, usual_s)
            if any(one.body_velocity.tolist()):
                self._zero_since_ns, self._stands, self._has_moved = None, False, True
            else:
                stand = [first] * self._note_zero(one.stamp_ns)
        else:
            first, many, usual_s = self._new_row(len(measured)), measured, self._took(measured)
            rows = slice(first, self._count)
            self._joined.write(
                rows, many.stamps_ns, many.body_velocities, many.covariances, usual_s
            )
            move = np.asarray(many.body_velocities.any(axis=1)).tolist()
            for row, stamp_ns in enumerate(many.stamps_ns.tolist(), first):
                if move[row - first]:
                    self._zero_since_ns, self._stands, self._has_moved = None, False, True
                elif self._note_zero(stamp_ns):
                    stand.append(row)
        if (angular := self._angular) is not None:
            self._joined.usual_s[first : self._count, 0] = self._angular_periods.usual_s
            stamps_ns = self._joined.stamps_ns[first : self._count]
            begin = stamps_ns.searchsorted(angular.stamp_ns)
            end = stamps_ns.searchsorted(angular.stamp_ns + self._timeout_ns, 'right')
            self._joined.write_angular(slice(first + begin, first + end), angular)
        if stand:  # zero, and known to be, unless a gyroscope says otherwise
            joined, still = self._joined, np.array(stand)
            rates = self._counts * joined.body_velocities[still, :3]
            turn = self.at_rest.turns(rates) & rates.any(axis=1)
            if np.count_nonzero(turn):
                self.doubt_standing()
                still = still[~turn]
            joined.body_velocities[still], joined.covariances[still] = 0.0, STANDING
            joined.is_stated[still] = True
        return True

    @property
    def median_period_s(self) -> float:
        """Median time between velocities, seconds, or 0; means over time count as any number."""
        return self._periods.median_s

    def _note_zero(self, stamp_ns: int) -> bool:
        """Note a velocity that is exactly zero; return whether the robot stands by then."""
        since_ns = self._zero_since_ns
        if since_ns is None or stamp_ns > self._last_zero_ns + self._timeout_ns:
            self._zero_since_ns = since_ns = stamp_ns
        self._last_zero_ns = stamp_ns
        self._stands = self._has_moved and stamp_ns >= since_ns + STANDS_NS
        return self._stands

    def doubt_standing(self) -> None:
        """Begin again to judge whether the robot stands: something else contradicts it."""
        self._zero_since_ns, self._stands = None, False

    def stood_s(self, stamp_ns: int) -> float:
        """Return for how long the robot has stood at a stamp, seconds; 0 while it moves."""
        if not self._stands or self._zero_since_ns is None:
            return 0.0
        return to_s(max(stamp_ns - self._zero_since_ns, 0))

    def _new_row(self, k: int) -> int:
        """Make room for so many more; return the first."""
        first, self._count = self._count, self._count + k
        if self._count > len(self._joined.stamps_ns):
            self._joined = self._joined.copied(slice(first), 2 * self._count)
        return first

    def _took(self, velocities: VelocityEvent | VelocityBlock) -> FloatArray | float:
        """Return for how long each was in force as a rule when it came, seconds."""
        if velocities.is_mean:  # their errors do not go on, however long they are held
            return self._periods.usual_s
        if isinstance(velocities, VelocityEvent):
            return self._periods.add(velocities.stamp_ns)
        return np.array(
            [self._periods.add(stamp_ns) for stamp_ns in velocities.stamps_ns.tolist()]
        )

    def _row(self, stamp_ns: int) -> int:
        """Return the row in force at a stamp."""
        return int(self._joined.stamps_ns[: self._count].searchsorted(stamp_ns, 'right')) - 1

    def latest(self, stamp_ns: int) -> FloatArray | None:
        """Return the velocity (6,) in force at ``stamp_ns``; None if none is or it timed out."""
        row, joined = self._row(stamp_ns), self._joined
        if stamp_ns - joined.since_ns[row, 1] > self._timeout_ns:
            return None
        return self._counting(joined.body_velocities[row])

    def in_force(self, stamp_ns: int) -> HeldVelocities | None:
        """Return the velocity in force, for a usual time or in a gap; None before the second."""
        row, joined = self._row(stamp_ns), self._joined
        period_s = self._periods.usual_s
        if math.isinf(period_s):  # of means over time, which have none
            period_s = to_s(int(joined.stamps_ns[row] - joined.stamps_ns[row - 1]))
        if row < 2 or period_s <= 0.0:
            return None
        one, flat = slice(row, row + 1), self.flat()
        lead_s, lead_velocities = lead(flat, row, stamp_ns)
        timed_out = stamp_ns - joined.since_ns[row, 1] > self._timeout_ns
        return HeldVelocities(
            body_velocities=self._counting(joined.body_velocities[one]),
            covariances=joined.covariances[one],
            is_stated=joined.is_stated[one],
            dt_s=np.array([0.0 if timed_out else period_s]),
            gap_s=np.array([period_s if timed_out else 0.0]),
            before_s=np.zeros((1, 2)),
            lead_s=lead_s,
            lead_velocities=lead_velocities,
            usual_s=np.array(flat[5:7]),
        )

    def held(self, start_ns: int, end_ns: int) -> HeldVelocities:
        """Return the velocities in force from ``start_ns`` to ``end_ns``."""
        found = held(self.flat(), start_ns, end_ns)
        return replace(found, body_velocities=self._counting(found.body_velocities))

    def flat(self) -> Velocities:
        """Return all that are known as plain arrays."""
        joined, count, linear_s = self._joined, self._count, self._periods.usual_s
        return Velocities(
            joined.stamps_ns[:count],
            joined.body_velocities[:count],
            joined.since_ns[:count],
            joined.is_stated[:count],
            joined.covariances[:count],
            linear_s if self._angular is None else self._angular_periods.usual_s,
            linear_s,
            self._timeout_ns,
        )

    def flat_then(self, stamps_ns: IntArray) -> list[Velocities]:
        """Return :meth:`flat` as it was at each of increasing stamps (s,)."""
        flat = self.flat()
        counts = flat.stamps_ns.searchsorted(stamps_ns, 'right')
        usual_s = self._joined.usual_s[counts - 1].tolist()
        return [
            flat._replace(
                stamps_ns=flat.stamps_ns[:count],
                body_velocities=flat.body_velocities[:count],
                since_ns=flat.since_ns[:count],
                is_stated=flat.is_stated[:count],
                covariances=flat.covariances[:count],
                usual_angular_s=angular_s,
                usual_linear_s=linear_s,
            )
            for count, (angular_s, linear_s) in zip(counts.tolist(), usual_s, strict=True)
        ]

    @property
    def begins_ns(self) -> int | None:
        """Stamp since which velocities are known, nanoseconds; None while there are none."""
        return int(self._joined.stamps_ns[1]) if self._count > 1 else None

    def forget_before(self, stamp_ns: int) -> None:
        """Drop velocities that were no longer in force at ``stamp_ns``."""
        count = self._count
        first = int(self._joined.stamps_ns[:count].searchsorted(stamp_ns, 'right')) - 1
        if first > count // 2:
            kept = np.append(0, np.arange(first, count))
            self._joined = self._joined.copied(kept, len(self._joined.stamps_ns))
            self._count = len(kept)

    def _counting(self, body_velocities: FloatArray) -> FloatArray:
        """Return what counts of velocities (…, 6), as a copy: for all of a step at once."""
        if self._is_planar:
            return flatten_velocities(body_velocities)
        return np.array(body_velocities)


class _AtRest:
    """What a gyroscope shows while wheels stand, in pieces that last twice as long each time.

    So bias is known the better the longer the robot stands, but with the logarithm of time alone,
    as its instability allows. The first piece is of a robot that may coast, and the second one
    begins in it: they say no more than which rate is to be taken for rest.
    """

    def __init__(self, rate: FloatArray) -> None:
        self._usual, self._rate = rate, rate  # (3,) as stated, and as found last
        self.means: list[tuple[FloatArray, FloatArray]] = []
        self._pieces, self._due_ns, self._before_ns = 0, 0, 0
        self._count, self._sum, self._squares = 0, np.zeros(3), np.zeros(3)

    def add(self, stood_ns: int, rate: FloatArray) -> None:
        """Take in a reading (3,), rad/s, ``stood_ns`` after wheels stopped."""
        if self._due_ns == 0 or stood_ns < self._before_ns:
            self._pieces, self._due_ns = 0, 3 * STANDS_NS // 4
            self._begin()
        self._before_ns = stood_ns
        off = rate - self._usual
        self._count, self._sum = self._count + 1, self._sum + off
        self._squares += off**2
        if stood_ns < self._due_ns or self._count < FEWEST_PERIODS:
            return
        mean = self._sum / self._count
        variances = np.maximum(self._squares / self._count - mean**2, 0.0) / (self._count - 1)
        self._pieces, self._due_ns = self._pieces + 1, 2 * stood_ns
        self._begin()
        if np.linalg.norm(mean) > TURNS:
            return
        self._rate = self._usual + mean
        if self._pieces > 2:
            self.means.append((self._rate, variances + INSTABILITY**2))

    def _begin(self) -> None:
        self._count, self._sum, self._squares = 0, np.zeros(3), np.zeros(3)

    def turns(self, rates: FloatArray) -> BoolArray:
        """Return which rates (k, 3), rad/s, are of a robot that turns."""
        return np.asarray(np.linalg.norm(rates - self._rate, axis=1) > TURNS)


class _Periods:
    """How long messages are in force as a rule, ``usual_s``: the longest period but one."""

    def __init__(self) -> None:
        self._block_ns: list[int] = []
        # The two longest of each block before: no others are among the two longest of all.
        self._longest_ns: deque[int] = deque(maxlen=2 * BLOCKS)
        self._last_ns: int | None = None
        self._usual_ns = -1  # what a period must be longer than to change it
        self.usual_s = math.inf
        self._recent_ns: deque[int] = deque(maxlen=BLOCK)

    def add(self, stamp_ns: int) -> float:
        """Take the stamp of the next message; return ``usual_s``."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if last_ns is None:
            return self.usual_s
        period_ns = stamp_ns - last_ns
        self._block_ns.append(period_ns)
        self._recent_ns.append(period_ns)
        is_full = len(self._block_ns) == BLOCK
        if is_full:
            self._longest_ns.extend(sorted(self._block_ns)[-2:])
            self._block_ns = []
        if is_full or period_ns > self._usual_ns:
            longest_ns = sorted([*self._longest_ns, *self._block_ns])[-2:]
            if len(longest_ns) == 2:
                self._usual_ns = longest_ns[0]
                self.usual_s = to_s(longest_ns[0]) or math.inf
        return self.usual_s

    @property
    def median_s(self) -> float:
        """Half of the periods of late are longer, seconds; 0 while there are few."""
        few = len(self._recent_ns) < FEWEST_PERIODS
        return 0.0 if few else to_s(int(median_low(self._recent_ns)))


@dataclass(frozen=True, slots=True, eq=False)
class _Joined:
    """Velocities in force between events; two columns: angular and linear part's message."""

    stamps_ns: IntArray  # (c,) from when on each is in force
    body_velocities: FloatArray  # (c, 6)
    covariances: FloatArray  # (c, 6, 6), zero where unknown
    is_stated: BoolArray  # (c, 2)
    since_ns: IntArray  # (c, 2)
    usual_s: FloatArray  # (c, 2) how long it was usual then that they are in force

    @classmethod
    def with_room_for(cls, capacity: int) -> _Joined:
        """Return unknown velocities."""
        return cls(
            np.full(capacity, NEVER_NS, dtype=np.int64),
            np.zeros((capacity, 6)),
            np.zeros((capacity, 6, 6)),
            np.zeros((capacity, 2), dtype=np.bool_),
            np.full((capacity, 2), NEVER_NS, dtype=np.int64),
            np.full((capacity, 2), np.inf),
        )

    def copied(self, rows: slice | IntArray, capacity: int) -> _Joined:
        """Return some of the velocities, with room for ``capacity`` of them."""
        roomy = _Joined.with_room_for(capacity)
        for field in fields(_Joined):
            kept = getattr(self, field.name)[rows]
            getattr(roomy, field.name)[: len(kept)] = kept
        return roomy

    def write(
        self,
        rows: slice | int,
        stamps_ns: IntArray | int,
        body_velocities: FloatArray,
        covariances: FloatArray | None,
        usual_s: FloatArray | float,
    ) -> None:
        """Fill in one row or several, once: others may see them."""
        self.stamps_ns[rows] = stamps_ns
        self.body_velocities[rows] = body_velocities
        # Entry by entry, which of one row takes a quarter of the time.
        self.since_ns[rows, 0] = self.since_ns[rows, 1] = stamps_ns
        self.usual_s[rows, 0] = self.usual_s[rows, 1] = usual_s
        if covariances is not None:
            self.covariances[rows] = covariances
            self.is_stated[rows, 0] = covariances[..., :3, :3].any(axis=(-2, -1))
            self.is_stated[rows, 1] = covariances[..., 3:, 3:].any(axis=(-2, -1))

    def repeat_last(self, row: int, stamp_ns: int) -> None:
        """Let the velocity before a row be in force from another stamp on, too."""
        for array in (self.body_velocities, self.covariances, self.is_stated, self.since_ns):
            array[row] = array[row - 1]
        self.stamps_ns[row] = stamp_ns

    def write_angular(self, rows: slice, angular: AngularVelocityEvent) -> None:
        """Put the other sensor's angular velocity in place of the velocities' own."""
        is_stated = angular.covariance is not None and bool(angular.covariance.any())
        self.body_velocities[rows, :3] = angular.angular_velocity
        self.covariances[rows, :3] = self.covariances[rows, :, :3] = 0.0
        self.covariances[rows, :3, :3] = angular.covariance if is_stated else 0.0
        self.is_stated[rows, 0] = is_stated
        self.since_ns[rows, 0] = angular.stamp_ns
