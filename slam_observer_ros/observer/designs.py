"""All gains by their names."""

from __future__ import annotations

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.observer.constant import ConstantGains
from slam_observer_ros.observer.gains import Gains
from slam_observer_ros.observer.riccati.riccati import RiccatiGains
from slam_observer_ros.settings.estimator_settings import Settings

DESIGNS: dict[str, type[Gains]] = {
    'constant': ConstantGains,
    'riccati': RiccatiGains,
}
"""The values of the parameter ``gains``, and what they are."""


def make_gains(settings: Settings, reference_pose: FloatArray) -> Gains:
    """Return what the setting ``gains`` names, at P° = ``reference_pose`` (4, 4)."""
    return DESIGNS[settings.gains](settings, reference_pose)
