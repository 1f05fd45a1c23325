"""Which landmarks are known: ids, counts and stamps as a struct of arrays."""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import (
    BoolArray,
    FloatArray,
    IntArray,
    is_automatic,
    LandmarkColumns,
)

REAL, FALSE = 19.0, 1.0
"""Landmarks without ids that existed, and false points, as if seen before the first: one in twenty
points is false where nothing is known yet.
"""

ERROR = 0.01
"""Probability that a landmark of the map does not exist, and that one which is forgotten does."""

SURE = math.log(1.0 / ERROR - 1.0)
"""Log odds from which on a landmark exists."""

MIN_SHARE, MOST_SHARE = 0.1, 0.9
"""Least and greatest share of observations in which a landmark in view is seen: of a loaded map
it may be small, and a landmark that was seen each time may yet be hidden.
"""


class Landmarks(NamedTuple):
    """Counts and stamps of n landmarks, changed in place."""

    counts: IntArray  # (n,) as in :class:`.LandmarkTable`, and so the others
    rejections: IntArray
    last_seen_ns: IntArray
    seen_before_ns: IntArray

    def accept(self, rows: IntArray, stamp_ns: int) -> None:
        """Count one more accepted observation of ``rows`` (m,)."""
        self.counts[rows] += 1
        self.rejections[rows] = 0
        later, last_ns = rows, self.last_seen_ns.take(rows)
        is_later = last_ns < stamp_ns
        if np.count_nonzero(is_later) < len(rows):
            later, last_ns = rows[is_later], last_ns[is_later]
        self.seen_before_ns[later] = last_ns
        self.last_seen_ns[later] = stamp_ns

    def unseen_s(self, rows: IntArray, stamp_ns: int) -> FloatArray:
        """Return how long ``rows`` (m,) have not been seen at a stamp, seconds; maybe infinite.

        Two observations of one stamp are of two sensors: at the second a landmark was unseen for
        as long as at the first.
        """
        since_ns = self.last_seen_ns.take(rows)
        is_seen_now = since_ns == stamp_ns
        if np.count_nonzero(is_seen_now):
            since_ns = np.where(is_seen_now, self.seen_before_ns.take(rows), since_ns)
        unseen_s: FloatArray = to_s(stamp_ns - since_ns)
        was_never_seen = since_ns < 0
        if np.count_nonzero(was_never_seen):
            unseen_s[was_never_seen] = np.inf
        return unseen_s

    def in_doubt(
        self, rows: IntArray, max_rejections: int, further: BoolArray | int = 0
    ) -> BoolArray:
        """Return which of the rows (m,) have been rejected too often to be trusted.

        That is ``max_rejections`` times, or once more than they were seen: what contradicts a
        landmark that was seen once or twice may itself be the outlier. Each of them may be about
        to be rejected ``further`` times.
        """
        rejections = self.rejections.take(rows, mode='wrap') + further  # −1 for a new one as well
        if not np.count_nonzero(rejections):  # as nearly always
            return np.zeros(len(rows), dtype=np.bool_)
        needed = np.minimum(self.counts[rows] + 1, max_rejections)
        return np.asarray(rejections >= needed)


class LandmarkTable(LandmarkColumns):
    """Book-keeping of n landmarks; row i belongs to the observer's landmark i."""

    COLUMNS: ClassVar = {
        **dict.fromkeys(
            (
                'ids',
                'counts',
                'rejections',
                'last_seen_ns',
                'seen_before_ns',
                'in_view',
                'passed',
                'missed',
                'born_ns',
                'was_sure',
            ),
            (np.int64, ()),
        ),
        'evidence': (np.float64, ()),
        'seen_cost': (np.float64, ()),
        'rejected_at': (np.float64, (3,)),
        'rejected_last': (np.float64, (3,)),
    }
    ids: IntArray  # (n,) in the order in which they were first seen
    counts: IntArray  # (n,) in how many observations each was seen and accepted
    rejections: IntArray  # (n,) rejections in a row, all at one position, up to now
    # (n,) stamps of the latest observation and the one before it; −1 for none in this run
    last_seen_ns: IntArray
    seen_before_ns: IntArray
    # (n,) log of how much likelier each makes what was seen of it than if it were a false point;
    # infinite where an id or a map says that it exists
    evidence: FloatArray
    # (n,) −2 ln of the likelihood of where each was seen, by what the filter knew then
    seen_cost: FloatArray
    # (n,) observations without ids that had it in view, how many since it was seen, and from how
    # many other places than before: from a robot that stands it may be hidden in all of them
    in_view: IntArray
    missed: IntArray
    passed: IntArray
    # (n,) stamp at which each was seen for the first time; −1 for one that a map had
    born_ns: IntArray
    was_sure: IntArray  # (n,) 1 where it was counted as one that surely exists, else 0
    # (n, 3) its position at the first and the last of the rejections, metres, reference frame
    rejected_at: FloatArray
    rejected_last: FloatArray

    def __init__(self) -> None:
        super().__init__()
        # how often those without ids that surely exist were in view, and were seen
        self._confirmed_in_view = 0
        self._confirmed_seen = 0
        self._false = FALSE  # points that were taken for landmarks
        self.prior = math.log(REAL / FALSE)  # log odds that a landmark just seen exists
        self._sort()

    def rows_of(self, ids: IntArray) -> IntArray:
        """Return the row of each id (m,), −1 where it is unknown."""
        if not len(self.ids):
            return np.full(len(ids), -1)
        position = self._sorted_ids.searchsorted(ids)
        rows = self._order.take(position, mode='clip')
        is_known = self.ids.take(rows) == ids
        return rows if np.count_nonzero(is_known) == len(ids) else np.where(is_known, rows, -1)

    def add(self, ids: IntArray, stamp_ns: int) -> None:
        """Let the last m landmarks, which have just been appended, be seen for the first time."""
        rows = np.arange(len(self) - len(ids), len(self))
        self.ids[rows] = ids
        self.take_for_new(rows, stamp_ns)
        self._sort()

    def add_known(self, ids: IntArray, counts: IntArray) -> None:
        """Let the last m landmarks be ones that were seen ``counts`` (m,) times before."""
        n = len(self) - len(ids)
        self.add(ids, -1)
        self.counts[n:] = counts
        self.evidence[n:] = np.inf

    def clear_time(self) -> None:
        """Take all landmarks as last seen before any stamp to come."""
        self.last_seen_ns[:] = self.seen_before_ns[:] = self.born_ns[:] = -1

    def renumber(self, rows: IntArray, ids: IntArray) -> None:
        """Give ``rows`` (m,) other ids (m,)."""
        self.ids[rows] = ids
        self.evidence[rows[~is_automatic(ids)]] = np.inf
        self._sort()

    @property
    def columns(self) -> Landmarks:
        """The columns that the step reads and changes, as views."""
        return Landmarks(self.counts, self.rejections, self.last_seen_ns, self.seen_before_ns)

    def accept(self, rows: IntArray, stamp_ns: int) -> None:
        """As :meth:`.Landmarks.accept`."""
        self.columns.accept(rows, stamp_ns)

    def unseen_s(self, rows: IntArray, stamp_ns: int) -> FloatArray:
        """As :meth:`.Landmarks.unseen_s`."""
        return self.columns.unseen_s(rows, stamp_ns)

    def reject(self, rows: IntArray, points: FloatArray, tolerances_m: FloatArray) -> None:
        """Count one more rejected observation of ``rows`` (m,).

        Only rejections in a row and at one position add up: ``points`` (m, 3) within
        ``tolerances_m`` (m,) of where the first of them was, metres.
        """
        again = self.are_rejected_again(rows, points, tolerances_m)
        self.rejections[rows] = np.where(again, self.rejections[rows] + 1, 1)
        self.rejected_at[rows[~again]] = points[~again]
        self.rejected_last[rows] = points

    def are_rejected_again(
        self, rows: IntArray, points: FloatArray, tolerances_m: FloatArray
    ) -> BoolArray:
        """Return which rows (m,) were rejected the last time, and at the same position."""
        shifts_m = np.linalg.norm(points - self.rejected_at[rows], axis=1)
        return np.asarray((self.rejections[rows] > 0) & (shifts_m <= tolerances_m))

    def in_doubt(self, rows: IntArray, max_rejections: int) -> BoolArray:
        """As :meth:`.Landmarks.in_doubt`."""
        return self.columns.in_doubt(rows, max_rejections)

    def note_in_view(self, rows: IntArray, seen: BoolArray, has_moved: bool = True) -> None:
        """Count one more observation that had rows (m,) in view, and which of them it saw.

        ``has_moved`` says whether it was made from another place than the one before.
        """
        confirmed = ~self.tentative[rows]
        self._confirmed_in_view += int(np.count_nonzero(confirmed))
        self._confirmed_seen += int(np.count_nonzero(confirmed & seen))
        self.in_view[rows] += 1
        self.missed[rows] = np.where(seen, 0, self.missed[rows] + 1)
        self.passed[rows] = np.where(seen, 0, self.passed[rows] + has_moved)

    def _sort(self) -> None:
        # The rows in the order of their ids, and these.
        self._order: IntArray = np.argsort(self.ids)
        self._sorted_ids: IntArray = self.ids[self._order]
        self.some_without_ids = bool(is_automatic(self.ids).any())

    @property
    def likely_share(self) -> float:
        """How often a landmark without an id is seen while in view, within likely limits."""
        share = self._confirmed_seen / max(self._confirmed_in_view, 1)
        return min(max(share, MIN_SHARE), MOST_SHARE)

    @property
    def rate(self) -> float:
        """−ln of the probability that a landmark in view, not hidden, is missed once."""
        return -math.log1p(-self.likely_share)

    @property
    def false_share(self) -> float:
        """The probability that one just seen does not exist."""
        return 1.0 / (1.0 + math.exp(self.prior))

    @property
    def tentative(self) -> BoolArray:
        """Which landmarks (n,) may not exist."""
        return np.asarray(self.evidence + self.prior < SURE)

    def existence(self, rows: IntArray) -> FloatArray:
        """Return the probability that ``rows`` (m,) exist, by all that was seen of them."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.evidence[rows] - self.prior)))

    def weigh(self, rows: IntArray, evidence: FloatArray) -> int:
        """Count evidence (m,) that ``rows`` exist; return how many surely do from now on."""
        self.evidence[rows] = after = self.evidence[rows] + evidence
        is_sure = (after + self.prior >= SURE) & (after < np.inf)
        now = rows[is_sure & (self.was_sure[rows] == 0)]
        if not len(now):  # as nearly always
            return 0
        self.was_sure[now] = 1
        self._confirmed_in_view += int(np.sum(self.in_view[now]))
        self._confirmed_seen += int(np.sum(self.counts[now]))
        return len(now)

    def hidden(self, rows: IntArray, has_moved: bool = False) -> FloatArray:
        """Return the probability that existing ``rows`` (m,), in view, are missed once more.

        The rate at which one in view is seen differs between landmarks and places. Where it is
        exponentially distributed about its mean q, one is missed k times in a row from one place
        with the probability 1/(1 + k q): one that is hidden soon says little more, from there.
        From n places it is (1 + k q / n)⁻ⁿ.
        """
        q, k, n = self.rate, self.missed[rows], 1 + self.passed[rows]
        then = n + has_moved
        before, after = n * np.log1p(k * q / n), then * np.log1p((k + 1) * q / then)
        return np.asarray(np.exp(before - after))

    def unlikely(self) -> IntArray:
        """Return rows without an id that hardly exist, or no more; learn how many are false.

        One that a map had stays in any case.
        """
        own = is_automatic(self.ids) & (self.born_ns >= 0)
        exist = float(self.existence(np.flatnonzero(own)).sum())
        false = float(np.count_nonzero(own)) - exist + self._false
        self.prior = math.log((exist + REAL) / max(false, FALSE))
        is_false = own & (self.evidence + self.prior < -SURE)
        self._false += float(np.count_nonzero(is_false & (self.was_sure == 0)))
        return np.flatnonzero(is_false)

    def unseen_since(self, stamp_ns: int) -> IntArray:
        """Return rows not seen since a stamp: least often seen first, then longest ago."""
        unseen = np.flatnonzero(self.last_seen_ns < stamp_ns)
        return unseen[np.lexsort((self.last_seen_ns[unseen], self.counts[unseen]))]

    def take_for_new(self, rows: IntArray, stamp_ns: int) -> None:
        """Take ``rows`` as seen for the first time, at a stamp."""
        self.last_seen_ns[rows] = self.born_ns[rows] = stamp_ns
        self.seen_before_ns[rows] = -1
        self.counts[rows] = 1
        self.rejections[rows] = 0
        self.evidence[rows] = np.where(is_automatic(self.ids[rows]), 0.0, np.inf)
        self.seen_cost[rows] = 0.0
        self.in_view[rows] = self.passed[rows] = self.missed[rows] = self.was_sure[rows] = 0

    def merge(self, rows: IntArray, copies: IntArray) -> None:
        """Count what was seen of ``copies`` (m,), which are about to go, for ``rows`` (m,)."""
        for counted in (self.counts, self.in_view, self.seen_cost):
            counted[rows] += counted[copies]
        is_later = self.last_seen_ns[copies] > self.last_seen_ns[rows]
        later, latest = rows[is_later], copies[is_later]
        for column in (self.last_seen_ns, self.seen_before_ns, self.missed, self.passed):
            column[later] = column[latest]
        self.rejections[rows] = 0
        self.evidence[rows] = np.maximum(self.evidence[rows], self.evidence[copies])

    def delete(self, rows: IntArray) -> None:
        """Delete rows; those behind move up."""
        super().delete(rows)
        self._sort()
