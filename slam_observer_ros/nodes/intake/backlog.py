"""How long messages wait to be read by a program that is busy."""

from __future__ import annotations

BEHIND_S = 0.3  # messages that wait for less, as while a map is loaded, are no matter
LASTING_S = 2.0  # how long messages have to wait for more than that before it is reported


class Backlog:
    """Distinguishes a program that can't keep up with a topic from one busy for a moment.

    ``wait_s`` is how long the last message has waited, seconds.
    """

    def __init__(self) -> None:
        self.wait_s = 0.0
        self._last_s = 0.0
        self._behind_since_s: float | None = None

    def add(self, wait_s: float, now_s: float) -> None:
        """Take how long a message that is read now, at a steady time, has waited, seconds.

        That is less than zero if the clock was set meanwhile.
        """
        is_long_ago = now_s - self._last_s > LASTING_S
        self.wait_s, self._last_s = max(wait_s, 0.0), now_s
        if self.wait_s <= BEHIND_S:
            self._behind_since_s = None
        elif self._behind_since_s is None or is_long_ago:
            self._behind_since_s = now_s

    def problem(self, topic: str, now_s: float) -> str:
        """Report that messages have waited for long and still do; empty if not."""
        since_s, last_s = self._behind_since_s, self._last_s
        if since_s is None or last_s - since_s < LASTING_S or now_s - last_s > LASTING_S:
            return ''
        return (
            f"the node does not keep up: messages on '{topic}' wait {self.wait_s:.1f} s to be "
            'read; send fewer of them, or make observations cheaper (gains: scheduled, '
            'max_landmarks)'
        )
