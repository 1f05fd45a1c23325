"""Landmarks out of view, to which corrections and changes of x come later, panel by panel.

A view (:class:`.PanelView`) shows them as they will be then, and changes nothing.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter.arrays import FilterArrays
from slam_observer_ros.filter.chart import Chart
from slam_observer_ros.filter.riccati.outside_landmarks import (
    MovedPanel,
    OutsideLandmarks,
    PanelView,
)
from slam_observer_ros.filter.riccati.postponed import PostponedCorrection
from slam_observer_ros.lie.matrices import transpose

REFERENCE_SHIFT_M = 0.1  # how far estimates of landmarks out of view may be from their references

CHANGE_INTERVAL = 64
"""Corrections until a change has come to all landmarks, if no other has to begin before."""

FOLDING = 3e7
"""Multiplications by which postponed corrections are worked off at each correction, at least."""


class FollowingLandmarks:
    """The landmarks of an observer that are not in P, with the work that is postponed."""

    def __init__(self, chart: Chart, observer: FilterArrays) -> None:
        self._axes, self._stride, self._has_turns = chart.axes, chart.stride, chart.turn > 0
        self._observer = observer
        self.outside = OutsideLandmarks(chart)
        # (n,) where each landmark is outside, −1 for nowhere; and (slots,) which ones are there
        self.slots: IntArray = np.full(len(observer.y_ref), -1)
        self._in_slots: IntArray = np.empty(0, dtype=np.int64)
        self.start(np.empty(0))
        self._changed = 0  # panels, since the last correction
        self._moved_panels: dict[int, MovedPanel] = {}  # where somebody has looked

    def copy(self, observer: FilterArrays) -> FollowingLandmarks:
        """Return an independent copy for a copy of the observer."""
        other = copy(self)
        other._observer, other._moved_panels = observer, self._moved_panels.copy()
        other.outside, other.postponed = self.outside.copy(), self.postponed.copy()
        return other

    def start(self, variances: FloatArray) -> None:
        """Postpone from now on the effect of corrections of x, whose ``variances`` these are."""
        self.postponed = PostponedCorrection(variances, self._axes.point, self._has_turns)

    # Slots

    def set_slots(self, slots: IntArray, outside: IntArray) -> None:
        """Let landmarks (n,) have these slots; rows ``outside`` are not in P."""
        self.slots = slots
        self._in_slots = np.full(self.outside.slots_each * len(self.outside.panels), -1)
        self._in_slots[slots[outside]] = outside

    def _in_panel(self, number: int) -> tuple[IntArray, BoolArray]:
        """Return the landmark of each slot (slots,) of a panel, and which slots have one."""
        each = self.outside.slots_each
        rows = self._in_slots[each * number : each * (number + 1)]
        return rows, rows >= 0

    # Views

    def out_of_view(self, number: int) -> IntArray:
        """Return the landmarks of a panel that are not in P."""
        rows, are_out = self._in_panel(number)
        return rows[are_out]

    def views(self, rows: IntArray) -> list[PanelView]:
        """Return landmarks (m,) out of view as they are now, panel by panel, ascending."""
        views, outside, k = [], self.outside, self._axes.point
        for number, local in outside.by_panel(self.slots[rows]):
            in_panel, are_out = self._in_panel(number)
            moved = None
            panel, shifts = outside.panels[number], np.zeros((len(in_panel), 3))
            if number in outside.unchanged:
                moved = self._moved(number, in_panel, are_out)
                panel, shifts = moved.panel, moved.shifts
            X = outside.completed(number, are_out, moved)
            shifts = shifts + self._shifts(self._points(in_panel) + shifts - panel.references, X)
            at, blocks = np.sort(local), X.reshape(len(in_panel), self._stride, -1)
            turns = self.postponed.turns(blocks[at, k:], panel.turned, self._axes)
            turns = turns if moved is None else turns @ moved.turns[at]
            views.append(
                PanelView(
                    in_panel[at],
                    blocks[at],
                    panel.own[at],
                    panel.references[at],
                    shifts[at],
                    turns,
                    moved,
                )
            )
        return views

    def joined(
        self, rows: IntArray, views: list[PanelView]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return X (m k, …), B (m k, m k) and references (m, 3) of landmarks in slot order."""
        b = self.outside.width
        blocks = [np.empty((0, self._stride, b)), *(view.X for view in views)]
        X = np.concatenate(blocks).reshape(self._stride * len(rows), b)
        references = np.concatenate([np.empty((0, 3)), *(view.references for view in views)])
        return X, self.outside.among(self.slots[rows], views), references

    def each(
        self, rows: IntArray, minus_Psi: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return X (m, k, …), the covariance (m, k, k) and reference (m, 3) of each position."""
        order = np.argsort(np.argsort(self.slots[rows]))
        k, views = self._axes.point, self.views(rows)
        X = np.concatenate([view.X for view in views])[order, :k]
        references = np.concatenate([view.references for view in views])[order]
        own = np.concatenate([view.own for view in views])[order, :k, :k]
        return X, own + (X @ minus_Psi) @ transpose(X), references

    def own_turns(self, rows: IntArray, minus_Psi: FloatArray) -> FloatArray:
        """Return the covariances (m, q, q) of each ω_i, rad²."""
        k, q = self._axes.point, self._stride - self._axes.point
        order = np.argsort(np.argsort(self.slots[rows]))
        covariances = [np.empty((0, q, q))]
        for view in self.views(rows):
            X = view.X[:, k:]
            covariances.append(view.own[:, k:, k:] + (X @ minus_Psi) @ transpose(X))
        return np.concatenate(covariances)[order]

    def _points(self, rows: IntArray) -> FloatArray:
        """Return where the observer has landmarks (m, 3) for now, metres."""
        points: FloatArray = self._observer.y_ref[rows] + self._observer.a[rows]
        return points

    def _shifts(self, off: FloatArray, X: FloatArray) -> FloatArray:
        """Return how far landmarks of a panel, ``off`` (slots, 3) their references, move."""
        shifts = np.zeros_like(off)
        if self.postponed.has_moved:
            k, X = self._axes.point, X.reshape(len(off), self._stride, -1)
            shifts[:, :k] = self.postponed.shifted(off[:, :k], X[:, :k]) - off[:, :k]
        return shifts

    # Changes

    def are_near(self, numbers: range) -> bool:
        """Return whether landmarks of panels are near their references.

        Tags of the panels that are found near are turned.
        """
        for number in numbers:
            rows, are_out = self._in_panel(number)
            X = self.outside.complete(number, are_out)
            off = self._points(rows) - self.outside.panels[number].references
            off += self._shifts(off, X)
            if np.linalg.norm(off[are_out], axis=1).max(initial=0.0) > REFERENCE_SHIFT_M:
                return False
            self._turn(number, X)
        if self._has_turns:
            self._forget_gains()
        return True

    def work(self) -> None:
        """Do a share of the postponed work."""
        outside = self.outside
        share = -(-len(outside.panels) // CHANGE_INTERVAL)
        for number in list(outside.unchanged)[: max(share - self._changed, 0)]:
            self._change(number)
        self._changed = 0
        outside.matrix.fold(FOLDING)

    def finish(self) -> None:
        """Do all postponed changes; only folding may be left."""
        for number in list(self.outside.unchanged):
            self._change(number)

    def catch_up(self, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Do all postponed work on landmarks in slot order; return :meth:`joined` of them.

        Their panels keep all columns of X.
        """
        for number, _ in self.outside.by_panel(self.slots[rows]):
            if number in self.outside.unchanged:
                self._change(number)
            self.outside.complete(number, self._in_panel(number)[1])
        views = self.views(rows)
        self._observer.a[rows] += np.concatenate([view.shifts for view in views])
        if self._has_turns:
            turns = np.concatenate([view.turns for view in views])
            self._observer.orientations.turn(rows, turns)
        return self.joined(rows, views)

    def _change(self, number: int) -> None:
        """Do the postponed change of a panel."""
        rows, are_out = self._in_panel(number)
        moved = self._moved(number, rows, are_out)
        self._observer.a[rows[are_out]] += moved.shifts[are_out]
        if self._has_turns:
            self._observer.orientations.turn(rows[are_out], moved.turns[are_out])
        self.outside.make(number, moved)
        del self._moved_panels[number]
        self._changed += 1

    def _moved(self, number: int, rows: IntArray, are_out: BoolArray) -> MovedPanel:
        """Return a panel after its change, found once: copies that look share it."""
        if self._observer.have_moved:
            self._moved_panels.clear()
        if number not in self._moved_panels:
            moved = self.outside.moved(number, self._points(rows), are_out)
            self._moved_panels[number] = moved
        return self._moved_panels[number]

    def _turn(self, number: int, X: FloatArray) -> None:
        """Turn the tags of a panel."""
        if not self._has_turns:
            return
        rows, are_out = self._in_panel(number)
        panel, each = self.outside.panels[number], X.reshape(len(rows), self._stride, -1)
        turns = self.postponed.turns(each[:, self._axes.point :], panel.turned, self._axes)
        self._observer.orientations.turn(rows[are_out], turns[are_out])
        panel.turned = len(self.postponed.gains or [])

    def _forget_gains(self) -> None:
        """Forget gains by which all tags have been turned."""
        panels, gains = self.outside.panels, self.postponed.gains
        done = min((panel.turned for panel in panels), default=0)
        if gains is not None and done:
            del gains[:done]
            for panel in panels:
                panel.turned -= done
