"""What one message measures, in the frame that it names."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, TypeAlias, TypeVar

from slam_observer_ros.events import AngularVelocityEvent, ObservationEvent, VelocityEvent

EventT = TypeVar('EventT', VelocityEvent, AngularVelocityEvent, ObservationEvent)


@dataclass(frozen=True)
class Measurement(Generic[EventT]):
    """An event in the frame ``frame_id``, the sensor's as a rule; empty if it has none."""

    frame_id: str
    event: EventT

    @property
    def stamp_ns(self) -> int:
        """Stamp of the event, nanoseconds."""
        return self.event.stamp_ns

    def with_stamp(self, stamp_ns: int) -> Measurement[EventT]:
        """Return the same with another stamp, nanoseconds."""
        return Measurement(self.frame_id, replace(self.event, stamp_ns=stamp_ns))


AnyMeasurement: TypeAlias = (
    Measurement[VelocityEvent] | Measurement[AngularVelocityEvent] | Measurement[ObservationEvent]
)
