"""Every filter by its name."""

from __future__ import annotations

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.observer.constant import ConstantFilter
from slam_observer_ros.observer.filter import Filter
from slam_observer_ros.observer.riccati.riccati import RiccatiFilter
from slam_observer_ros.observer.scheduled.scheduled import ScheduledFilter
from slam_observer_ros.settings.estimator_settings import Settings

DESIGNS: dict[str, type[Filter]] = {
    'constant': ConstantFilter,
    'scheduled': ScheduledFilter,
    'riccati': RiccatiFilter,
}
"""The values of the parameter ``gains``, and their filters."""


def make_filter(settings: Settings, reference_pose: FloatArray) -> Filter:
    """Return the filter that the setting ``gains`` names, at P° = ``reference_pose`` (4, 4)."""
    return DESIGNS[settings.gains](settings, reference_pose)
