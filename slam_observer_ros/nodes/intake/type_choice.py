"""Which of the message types on a topic is listened for."""

from __future__ import annotations

from collections.abc import Sequence

TRY_S = 2.0
"""How long a type that has not come yet is waited for while others are published as well."""

KEEP_S = 5.0
"""How long a type that has come before must be silent until another one is tried."""


class TypeChoice:
    """Chooses the type that flows among those that are published on one topic.

    A topic can be heard with one type at a time. A publisher may be silent for ever, as a
    teleoperation that nobody uses, so that being published does not show which type flows.

    Attributes
    ----------
    chosen : str
        The type that is listened for; '' before the first.

    """

    def __init__(self) -> None:
        self.chosen = ''
        self._since_s = 0.0
        self._tried: set[str] = set()
        self._have_come: set[str] = set()

    def choose(self, type_name: str, now_s: float) -> bool:
        """Note that a type is listened for; return whether it is for the first time."""
        is_new = type_name not in self._tried
        self.chosen, self._since_s = type_name, now_s
        self._tried.add(type_name)
        return is_new

    def note_message(self) -> None:
        """Note that the chosen type has come."""
        self._have_come.add(self.chosen)

    def best_of(self, published: Sequence[str], last_s: float, now_s: float) -> str:
        """Return which of the published types to listen for, by the time of the last message."""
        if self.chosen not in published:
            return published[0]
        patience_s = KEEP_S if self.chosen in self._have_come else TRY_S
        if now_s - max(self._since_s, last_s) < patience_s:
            return self.chosen
        return published[(published.index(self.chosen) + 1) % len(published)]
