"""The SLAM_n(3) observer of Mahony and Hamel: a numpy library, ROS 2 nodes and offline tools."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
import sys
from types import ModuleType
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


_EARLIER_ROOMS = {
    'association': 'tracking',
    'geometry': 'lie',
    'inputs': 'recordings',
    'known_map': 'mapping',
    'observer': 'filter',
    'recording': 'recordings',
    'sensor_models': 'models',
    'state': 'tracking',
}
"""What folders of modules were called in snapshots before 0.1.0, whose scripts go on to work."""


class _EarlierNames(MetaPathFinder, Loader):
    """Finds modules by the names that their folders had."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return a specification of what is in another folder by now."""
        parts = name.split('.')
        is_earlier = parts[0] == __name__ and len(parts) > 1 and parts[1] in _EARLIER_ROOMS
        return ModuleSpec(name, self) if is_earlier else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module itself, which keeps its own name."""
        package, room, *rest = spec.name.split('.')
        module = import_module('.'.join([package, _EARLIER_ROOMS[room], *rest]))
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Leave it as it is: it was executed by its own name."""
        if module.__spec__ is not None:
            module.__spec__ = module.__spec__.loader_state


sys.meta_path.insert(0, _EarlierNames())  # or the same file would be two modules
