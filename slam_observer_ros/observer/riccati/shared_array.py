"""Arrays that several owners share until one of them changes its own."""

from __future__ import annotations

from weakref import WeakSet

from slam_observer_ros.common.types import FloatArray


class SharedArray:
    """An array that is copied when it is to be changed while others have it."""

    def __init__(self, array: FloatArray, owner: object) -> None:
        self.array = array  # to be changed only by the owner of :meth:`owned_by`
        self._owners = WeakSet([owner])

    def share(self, owner: object) -> SharedArray:
        """Return this, which another owner now has, too."""
        self._owners.add(owner)
        return self

    def owned_by(self, owner: object) -> SharedArray:
        """Return this if nobody else has it, or else a copy."""
        if len(self._owners) == 1:
            return self
        self._owners.discard(owner)
        return SharedArray(self.array.copy(), owner)
