"""What the parts of ``make benchmark`` measure, as numbers in tables."""

from __future__ import annotations

from typing import TypeAlias, TypedDict


class Table(TypedDict):
    """Numbers under ``columns``, by row; None where there is none."""

    columns: list[str]
    rows: dict[str, list[float | None]]


Tables: TypeAlias = dict[str, Table]
"""Tables by the name that docs/performance.md gives them."""


def ratios(measured: dict[str, list[float]], columns: list[str], unit: float) -> Table:
    """Return what was measured as multiples of a unit."""
    rows: dict[str, list[float | None]] = {
        name: [value / unit for value in values] for name, values in measured.items()
    }
    return Table(columns=columns, rows=rows)
