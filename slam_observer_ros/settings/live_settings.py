"""The settings in force: one object, read where it is used, as some change while running."""

from __future__ import annotations

from dataclasses import fields

from slam_observer_ros.settings.estimator_settings import Settings


class LiveSettings(Settings):
    """A copy of settings that follows changes; all that hold it see them, and copies share it."""

    @classmethod
    def of(cls, settings: Settings) -> LiveSettings:
        """Return such a copy."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(settings)})

    def follow(self, settings: Settings) -> None:
        """Take over the values of other settings."""
        for field in fields(self):
            object.__setattr__(self, field.name, getattr(settings, field.name))
