"""Gain designs: how residuals become the innovation (Δ, δ_i) of the one observer."""

from __future__ import annotations

from collections.abc import Callable

from slam_observer_ros.gains.base import GainDesign
from slam_observer_ros.gains.constant import ConstantGains
from slam_observer_ros.gains.fixed_map import FixedMapGains
from slam_observer_ros.gains.riccati import RiccatiGains
from slam_observer_ros.gains.scheduled import ScheduledGains
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import FloatArray

DESIGNS: dict[str, Callable[[Settings], GainDesign]] = {
    'constant': ConstantGains,
    'scheduled': ScheduledGains,
    'riccati': RiccatiGains,
}
"""Every gain design by its name, the values of the parameter ``gains``."""


def make_gains(settings: Settings) -> GainDesign:
    """Return the gain design that ``settings.gains`` names."""
    return DESIGNS[settings.gains](settings)


def held(gains: GainDesign, landmark_covariances: FloatArray) -> GainDesign:
    """Return gains that know what ``gains`` do, and never move a landmark again.

    ``landmark_covariances`` (n, 3, 3), reference frame, m², are what the map says of its
    landmarks. They are only passed on.
    """
    if isinstance(gains, RiccatiGains):
        return FixedMapGains(gains, landmark_covariances)
    gains.hold_landmarks(len(landmark_covariances))
    return gains
