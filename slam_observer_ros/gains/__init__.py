"""Gain designs: how residuals become the innovation (Δ, δ_i) of the one observer."""

from __future__ import annotations

from slam_observer_ros.gains.base import GainDesign
from slam_observer_ros.gains.constant import ConstantGains
from slam_observer_ros.settings import Settings


def make_gains(settings: Settings) -> GainDesign:
    """Return the gain design that ``settings.gains`` names."""
    return ConstantGains(settings)
