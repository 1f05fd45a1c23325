"""The settings in force: one object, read where they are used, as some change while running."""

from __future__ import annotations

from slam_observer_ros.common.types import Immutable
from slam_observer_ros.settings.estimator_settings import Settings


class LiveSettings(Immutable):
    """Holds the settings; copies of what reads them share it.

    Attributes
    ----------
    now : Settings
        The settings in force.

    """

    def __init__(self, settings: Settings) -> None:
        self.now = settings
