"""Landmarks out of view, and how they depend on the local state x of the others.

The error of a landmark's position is η_i = ξ_i − [y_i°]× ε_Ω, with a reference y_i°: it does not
move while the robot does. The error of a tag's orientation is ω_i itself. A landmark has a slot,
some rows of all arrays, and keeps it while it is in view: these rows are out of date then, and X
is zero there. A change of all landmarks is made panel by panel (:class:`PanelChange`).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter.chart import Chart
from slam_observer_ros.filter.riccati.postponed import PANEL_ROWS, PanelMatrix, PostponedCorrection
from slam_observer_ros.lie.matrices import diagonal_blocks, transpose


@dataclass(frozen=True, slots=True, eq=False)
class PanelChange:
    """A change of all landmarks, begun when x started again: with q entries, then fewer."""

    postponed: PostponedCorrection  # corrections until then
    Phi: FloatArray  # (q, q₀)
    root: FloatArray  # (q₀, r) of Ψ
    taken: IntArray  # slots that are the last columns of X until then
    turns: FloatArray  # (s, q) covariance of the angles of ε with x
    kept: IntArray  # entries of x that stay
    slots: IntArray  # (m,) slots of landmarks that are not in x any more, ascending
    points: FloatArray  # (m, 3) references of these landmarks
    rows: IntArray  # (m k,) their rows of B
    columns: IntArray  # (m k,) entries of x that they were
    turning: FloatArray  # (m k, p) T of η = ξ − T ε
    own: FloatArray  # (m k, m k) their covariance
    to_x: FloatArray  # (m k, …) their covariance with the entries that stay

    @property
    def weights(self) -> FloatArray:
        """(r + 2 s,) w of the U diag(w) Uᵀ that is added to B."""
        s = len(self.turns)
        return np.repeat([-1.0, 0.5, -0.5], [self.root.shape[1], s, s])


@dataclass(slots=True, eq=False)
class Panel:
    """The landmarks of a panel. Its arrays are never changed in place: copies share them."""

    X: FloatArray  # (PANEL_ROWS, …) cov(η, x₀), then the columns of η taken in, maybe not all
    own: FloatArray  # (slots, k, k) diagonal blocks of B
    references: FloatArray  # (slots, 3) y_i°, metres
    turned: int = 0  # how many corrections since x began have turned the tags


@dataclass(frozen=True, slots=True, eq=False)
class MovedPanel:
    """Landmarks of a panel after a change."""

    panel: Panel
    shifts: FloatArray  # (slots, 3) how far estimates have been moved, metres
    turns: FloatArray  # (slots, 3, 3) how orientations have been turned
    U: FloatArray  # (PANEL_ROWS, r + 2 s) to be added to B
    V: FloatArray  # (PANEL_ROWS, m k) columns of B of the landmarks that are not in x any more


@dataclass(frozen=True, slots=True, eq=False)
class PanelView:
    """Landmarks (m,) of a panel as they are now, after all that is postponed."""

    rows: IntArray  # (m,) which landmarks
    X: FloatArray  # (m, k, …) with all columns
    own: FloatArray  # (m, k, k)
    references: FloatArray  # (m, 3) metres
    shifts: FloatArray  # (m, 3) how far estimates have yet to be moved, metres
    turns: FloatArray  # (m, 3, 3) how orientations have yet to be turned
    moved: MovedPanel | None  # their panel after the change that it waits for


class OutsideLandmarks:
    """B, the covariance of all η, and X = cov(η, x), both as of one instant.

    The columns of X are the variables that x had when it last started, (q₀), then the η of
    landmarks that have been taken in since.
    """

    def __init__(self, chart: Chart) -> None:
        self._chart, self._axes, self._stride = chart, chart.axes, chart.stride
        self.matrix = PanelMatrix()  # B
        self.panels: list[Panel] = []
        self.size = 0  # q₀
        self.taken: IntArray = np.empty(0, dtype=np.int64)  # (t,) slots
        self.unchanged: dict[int, PanelChange] = {}  # panels that wait for a change
        self._unused: list[int] = []
        self._left: list[int] = []  # slots of landmarks that were removed

    def copy(self) -> OutsideLandmarks:
        """Return an independent copy."""
        other = copy(self)
        other.matrix, other.panels = self.matrix.copy(), [copy(panel) for panel in self.panels]
        other.unchanged = self.unchanged.copy()
        other._unused, other._left = self._unused.copy(), self._left.copy()
        return other

    @property
    def slots_each(self) -> int:
        """How many slots a panel has."""
        return PANEL_ROWS // self._stride

    @property
    def width(self) -> int:
        """How many columns X has; some panels may not have the last ones yet."""
        return self.size + self._stride * len(self.taken)

    def rows(self, slots: IntArray) -> IntArray:
        """Return where landmarks are in B (m k,)."""
        return self._rows(slots).ravel()

    def new_slots(self, count: int) -> IntArray:
        """Return free slots for so many landmarks, ascending."""
        used = self._left[:count]
        self._left = self._left[len(used) :]
        return np.sort(np.append(used, self._unused_slots(count - len(used)))).astype(np.int64)

    def _unused_slots(self, count: int) -> IntArray:
        """Return so many slots, ascending, where B is zero."""
        each, k = self.slots_each, self._stride
        while len(self._unused) < count:
            self._unused += range(each * len(self.panels), each * (len(self.panels) + 1))
            X, own = np.zeros((PANEL_ROWS, self.width)), np.zeros((each, k, k))
            self.panels.append(Panel(X, own, np.zeros((each, 3))))
            self.matrix.append()
        slots, self._unused = self._unused[:count], self._unused[count:]
        return np.array(slots, dtype=np.int64)

    def remove(self, slots: IntArray) -> None:
        """Forget landmarks; others will take their rows of B."""
        self.clear(slots)
        self._left += slots.tolist()

    def clear(self, slots: IntArray) -> None:
        """Let X of landmarks be zero."""
        for number, local in self.by_panel(slots):
            X = self.panels[number].X.copy()
            X[self.rows(local)] = 0.0
            self.panels[number].X = X

    def take(self, slots: IntArray) -> None:
        """Let landmarks be in x from now on."""
        self.clear(slots)
        self.taken = np.append(self.taken, slots)

    def by_panel(self, slots: IntArray) -> list[tuple[int, IntArray]]:
        """Return the panels of some slots, and the slots within each panel."""
        numbers = slots // self.slots_each
        return [
            (int(number), slots[numbers == number] % self.slots_each)
            for number in np.unique(numbers)
        ]

    def add_independent(self, points: FloatArray, covariances: FloatArray) -> IntArray:
        """Add landmarks (m,) whose errors are independent of all others; return their slots."""
        slots = self._unused_slots(len(points))
        self._set_own(slots, slice(self._stride), covariances)
        self.refer(slots, points)
        return slots

    def set_independent(self, slots: IntArray, entries: slice, covariances: FloatArray) -> None:
        """Let these entries of landmarks (m,), ascending, be independent of all others.

        Their covariances are (m, …, …). Nothing may be taken, and no change be going on.
        """
        rows = self._rows(slots)[:, entries].ravel()
        for number, panel in enumerate(self.panels):
            self.matrix.set_columns(number, rows, np.zeros((PANEL_ROWS, len(rows))))
            local = rows[rows // PANEL_ROWS == number] % PANEL_ROWS
            if len(local):
                panel.X = panel.X.copy()
                panel.X[local] = 0.0
        self._set_own(slots, entries, covariances)

    def _set_own(self, slots: IntArray, entries: slice, covariances: FloatArray) -> None:
        """Set the diagonal blocks of B of landmarks, ascending, which are zero."""
        begin = 0
        for number, local in self.by_panel(slots):
            blocks, panel = covariances[begin : begin + len(local)], self.panels[number]
            begin += len(local)
            self.matrix.add_blocks(number, self._rows(local)[:, entries], blocks)
            panel.own = panel.own.copy()
            panel.own[local, entries] = panel.own[local, :, entries] = 0.0
            panel.own[local, entries, entries] = blocks

    def refer(self, slots: IntArray, points: FloatArray) -> None:
        """Let landmarks, ascending, refer to ``points`` (m, 3)."""
        begin = 0
        for number, local in self.by_panel(slots):
            references = self.panels[number].references.copy()
            references[local] = points[begin : begin + len(local)]
            self.panels[number].references = references
            begin += len(local)

    def among(self, slots: IntArray, views: list[PanelView]) -> FloatArray:
        """Return B (m k, m k) of landmarks, ascending, given their views."""
        rows, parts = self.rows(slots), self.by_panel(slots)
        U = [self.matrix.rows_of_U(number) for number, _ in parts]
        for i, view in enumerate(views):
            U[i] = U[i] if view.moved is None else np.hstack([U[i], view.moved.U])
        of_U = [each[self.rows(local)] for each, (_, local) in zip(U, parts, strict=True)]
        found = self.matrix.among(
            rows, np.concatenate([np.empty((0, self.matrix.columns_of_U)), *of_U])
        )
        # Columns that have yet to be written.
        end = 0
        for view, (number, local) in zip(views, parts, strict=True):
            mine = np.arange(end, end := end + self._stride * len(local))
            if view.moved is not None:
                changed = self.unchanged[number].rows
                at = np.flatnonzero(np.isin(rows, changed))
                V = view.moved.V[np.ix_(self.rows(local), np.isin(changed, rows))]
                found[np.ix_(mine, at)], found[np.ix_(at, mine)] = V, V.T
        return found

    # Changes

    def begin(self, change: PanelChange) -> None:
        """Begin a change of all landmarks; there may be no other one yet."""
        self.unchanged = dict.fromkeys(range(len(self.panels)), change)
        self.taken = np.empty(0, dtype=np.int64)
        self.size = len(change.kept) if self.panels else 0  # where nothing is, nothing has to be
        self.matrix.begin(change.weights)
        if not self.panels:
            self.matrix.end()

    def moved(self, number: int, points: FloatArray, are_out: BoolArray) -> MovedPanel:
        """Return a panel after its change; landmarks that ``are_out`` are not in x.

        The change has not yet moved the estimates ``points`` (slots, 3) of its landmarks.
        """
        change, panel, k = self.unchanged[number], self.panels[number], self._axes.point
        at = change.slots // self.slots_each == number
        new = change.slots[at] % self.slots_each  # landmarks that were in x
        were_out = are_out.copy()
        were_out[new] = False
        size = change.Phi.shape[1] - self._stride * len(change.taken)
        before = self._completed(number, size, change.taken, were_out)
        X = before @ change.Phi.T
        # Where the estimate has moved to, the reference follows, …
        was_off = np.where(were_out[:, None], points - panel.references, 0.0)
        off, each = was_off.copy(), before.reshape(len(points), self._stride, -1)
        off[:, :k] = change.postponed.shifted(was_off[:, :k], each[:, :k])
        turns = change.postponed.turns(each[:, k:], panel.turned, self._axes)
        s = len(change.turns)
        D = np.zeros((PANEL_ROWS, s))
        D.reshape(len(points), self._stride, s)[:, :k] = -self._chart.still(off)[:, :, :s]
        # … D Zᵀ + Z Dᵀ, as the difference of two squares.
        Z = X[:, :s] + 0.5 * D @ change.turns[:, :s]
        U = np.hstack([before @ change.root, D + Z, D - Z])
        X += D @ change.turns
        V = X[:, change.columns] - X[:, : change.turning.shape[1]] @ change.turning.T
        X = X[:, change.kept]
        blocks = U.reshape(len(points), self._stride, U.shape[1])
        own = panel.own + (blocks * change.weights) @ transpose(blocks)
        references = panel.references + off
        rows, of_change = self.rows(new), np.repeat(at, self._stride)
        X[rows], V[rows] = change.to_x[of_change], change.own[of_change]
        own[new] = diagonal_blocks(change.own, self._stride)[at]
        references[new] = change.points[at]
        return MovedPanel(Panel(X, own, references), off - was_off, turns, U, V)

    def make(self, number: int, moved: MovedPanel) -> None:
        """Let a panel have changed."""
        change = self.unchanged.pop(number)
        self.panels[number] = copy(moved.panel)
        self.matrix.add(number, moved.U)
        self.matrix.set_columns(number, change.rows, moved.V)
        if not self.unchanged:
            self.matrix.end()

    def complete(self, number: int, are_out: BoolArray) -> FloatArray:
        """Return X of a panel with all its columns, and keep it."""
        X = self._completed(number, self.size, self.taken, are_out)
        self.panels[number].X = X
        return X

    def completed(
        self, number: int, are_out: BoolArray, moved: MovedPanel | None = None
    ) -> FloatArray:
        """Return X of a panel with all its columns, maybe after a change it waits for."""
        if moved is None:
            return self._completed(number, self.size, self.taken, are_out)
        rows, changed = self.rows(np.sort(self.taken)), self.unchanged[number].rows
        U = np.hstack([self.matrix.rows_of_U(number), moved.U])
        columns = self.matrix.columns(number, rows, U)
        of_rows, of_V = np.isin(rows, changed), np.isin(changed, rows)
        columns[:, of_rows] = moved.V[:, of_V]
        columns[~np.repeat(are_out, self._stride)] = 0.0
        return np.hstack([moved.panel.X, columns[:, self._order(self.taken)]])

    def _completed(
        self, number: int, size: int, taken: IntArray, are_out: BoolArray
    ) -> FloatArray:
        """Return X of a panel for x of ``size`` entries at its start, and ``taken`` since."""
        X = self.panels[number].X
        rest = taken[(X.shape[1] - size) // self._stride :]
        if not len(rest):
            return X
        columns = self.matrix.columns(number, self.rows(np.sort(rest)))
        columns[~np.repeat(are_out, self._stride)] = 0.0
        return np.hstack([X, columns[:, self._order(rest)]])

    def _rows(self, slots: IntArray) -> IntArray:
        rows: IntArray = self._stride * slots[:, None] + np.arange(self._stride)
        return rows

    def _order(self, slots: IntArray) -> IntArray:
        """Return where the columns of landmarks are once they are sorted."""
        return self.rows(np.argsort(np.argsort(slots)))
