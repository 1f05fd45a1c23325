"""The SLAM_n(3) observer of Mahony and Hamel: a numpy library, ROS 2 nodes and offline tools."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from slam_observer_ros import common

if TYPE_CHECKING:
    from slam_observer_ros.common.process import use_one_thread
    from slam_observer_ros.estimator.estimator import Estimator
    from slam_observer_ros.events import AngularVelocityEvent, ObservationEvent, VelocityEvent
    from slam_observer_ros.mapping.landmark_map import LandmarkMap
    from slam_observer_ros.settings.estimator_settings import Settings

__version__ = common.__version__

__all__ = [
    'AngularVelocityEvent',
    'Estimator',
    'LandmarkMap',
    'ObservationEvent',
    'Settings',
    'VelocityEvent',
    'use_one_thread',
]

_MODULES = {
    'AngularVelocityEvent': 'events',
    'Estimator': 'estimator.estimator',
    'LandmarkMap': 'mapping.landmark_map',
    'ObservationEvent': 'events',
    'Settings': 'settings.estimator_settings',
    'VelocityEvent': 'events',
    'use_one_thread': 'common.process',
}
"""Where the names are defined; none is imported before it is used, as scipy takes a while."""


def __getattr__(name: str) -> object:
    """Import the module of an exported name."""
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f'{__name__}.{_MODULES[name]}'), name)
