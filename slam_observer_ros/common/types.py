"""Arrays: their types, columns with a row for each landmark, and the numbers of these."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy, deepcopy
from typing import Any, ClassVar, TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

if TYPE_CHECKING:
    from typing_extensions import Self

FloatArray: TypeAlias = NDArray[np.float64]  # docstrings state shape, unit and frame
IntArray: TypeAlias = NDArray[np.int64]  # landmark ids, indices, stamps in nanoseconds
BoolArray: TypeAlias = NDArray[np.bool_]  # array of bool: masks over landmarks
FIRST_AUTOMATIC_ID = 10_000_000  # landmarks whose sensor gives no ids are numbered from here on
LAST_AUTOMATIC_ID = 2**24 - 1  # up to here, which float32, as in a PointCloud, has exactly
LEAST_ROOM = 16  # rows for which there is room at first


class LandmarkColumns:
    """Arrays of n rows, row i of each being of landmark i, with room for more rows.

    A subclass names them in ``COLUMNS``, with the type and shape of a row. Each is an attribute,
    a view of its first n rows: it is written to in place, and only taking in and removing
    landmarks replaces it.
    """

    COLUMNS: ClassVar[Mapping[str, tuple[DTypeLike, tuple[int, ...]]]]

    def __init__(self) -> None:
        self._stores: dict[str, NDArray[Any]] = {
            name: np.zeros((LEAST_ROOM, *shape), dtype)
            for name, (dtype, shape) in self.COLUMNS.items()
        }
        self._show(0)

    def __len__(self) -> int:
        """Return n."""
        return self._count

    def copy(self) -> Self:
        """Return an independent copy: one copy of memory an array."""
        other = copy(self)
        other._stores = {name: store.copy() for name, store in self._stores.items()}
        other._show(self._count)
        return other

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """Return a copy whose columns are views again, and which shares what others share."""
        memo[id(self)] = other = copy(self)
        for name, value in vars(self).items():
            if name not in self.COLUMNS:
                setattr(other, name, deepcopy(value, memo))
        other._show(self._count)
        return other

    def append_zeros(self, m: int) -> IntArray:
        """Append rows; return which (m,)."""
        n = self._count
        for name, store in self._stores.items():
            if n + m > len(store):
                roomy = np.zeros((max(n + m, 2 * len(store)), *store.shape[1:]), store.dtype)
                roomy[:n] = store[:n]
                self._stores[name] = roomy
        self._show(n + m)
        return np.arange(n, n + m)

    def delete(self, rows: IntArray) -> None:
        """Delete rows; those behind move up."""
        are_kept = np.ones(self._count, dtype=np.bool_)
        are_kept[rows] = False
        kept = np.flatnonzero(are_kept)
        for store in self._stores.values():
            store[: len(kept)] = store[kept]
            store[len(kept) : self._count] = 0
        self._show(len(kept))

    def _show(self, count: int) -> None:
        self._count = count
        for name, store in self._stores.items():
            setattr(self, name, store[:count])


def is_automatic(ids: IntArray) -> BoolArray:
    """Return which ids (m,) were given to landmarks whose sensor gives none."""
    automatic: BoolArray = (ids >= FIRST_AUTOMATIC_ID) & (ids <= LAST_AUTOMATIC_ID)
    return automatic
