"""Gain designs: how residuals become the innovation (Δ, δ_i) of the one observer."""

from __future__ import annotations

from collections.abc import Callable

from slam_observer_ros.observer.constant import ConstantGains
from slam_observer_ros.observer.filter import GainDesign
from slam_observer_ros.observer.riccati.full_map import FullMapGains
from slam_observer_ros.observer.scheduled.scheduled import ScheduledGains
from slam_observer_ros.settings.estimator_settings import Settings

DESIGNS: dict[str, Callable[[Settings], GainDesign]] = {
    'constant': ConstantGains,
    'scheduled': ScheduledGains,
    'riccati': FullMapGains,
}
"""Every gain design by its name, the values of the parameter ``gains``."""


def make_gains(settings: Settings) -> GainDesign:
    """Return the gain design that ``settings.gains`` names."""
    return DESIGNS[settings.gains](settings)
