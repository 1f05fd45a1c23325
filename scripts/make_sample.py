#!/usr/bin/env python3
"""Make samples/sample.mcap, the recording that a newcomer replays first.

The project's own simulation: a robot that drives circles for two minutes, with a camera of limited
view, and the noise that the default settings state.
"""

from __future__ import annotations

from pathlib import Path

from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.simulation import Scenario, Simulation

PATH = Path(__file__).resolve().parent.parent / 'samples' / 'sample.mcap'
START_NS = 1_000_000_000
SCENARIO = Scenario(
    duration=120.0,
    velocity_rate=20.0,
    observation_rate=5.0,
    seed=3,
    initial_bias=0.0,
    landmark_count=40,
    landmark_distance=8.0,
    angular_velocity_noise=0.134,  # 0.03 rad/√s at 20 Hz
    linear_velocity_noise=0.089,  # 0.02 m/√s at 20 Hz
    point_noise=0.1,
    field_of_view=80.0,
    max_range=7.0,
)


def main() -> None:
    """Write the recording anew."""
    simulation = Simulation(SCENARIO, START_NS)
    PATH.parent.mkdir(exist_ok=True)
    with RecordingWriter(PATH, overwrite=True) as writer:
        writer.write_landmarks(START_NS, simulation.landmark_truth(START_NS))
        for delivery in simulation.deliveries():
            writer.write_event(delivery.event)


if __name__ == '__main__':
    main()
