"""Every filter by its name."""

from __future__ import annotations

from collections.abc import Callable

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.observer.constant import ConstantFilter
from slam_observer_ros.observer.filter import Filter
from slam_observer_ros.observer.riccati.riccati import RiccatiFilter
from slam_observer_ros.observer.scheduled.scheduled import ScheduledFilter
from slam_observer_ros.settings.live_settings import LiveSettings

DESIGNS: dict[str, Callable[[LiveSettings, FloatArray], Filter]] = {
    'constant': ConstantFilter,
    'scheduled': ScheduledFilter,
    'riccati': RiccatiFilter,
}
"""The values of the parameter ``gains``, and what makes the filter at a reference pose."""


def make_filter(live: LiveSettings, reference_pose: FloatArray) -> Filter:
    """Return the filter that the setting ``gains`` names, at P° = ``reference_pose`` (4, 4)."""
    return DESIGNS[live.now.gains](live, reference_pose)
