"""What an observation may mean: points without an id, and points whose id may be wrong.

After a long blind stretch the gate is wide, and a wrong id passes it. Taken for the landmark that
it names, such a point would close a loop where there is none and throw the pose. So it is read
both ways, as what it says and as an outlier, and later observations decide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.association import find_readings, RESOLUTION
from slam_observer_ros.events import ObservationEvent, select, UNKNOWN_ID
from slam_observer_ros.gains.base import Innovation
from slam_observer_ros.gains.riccati import RiccatiGains
from slam_observer_ros.gains.robust import distances, mahalanobis, with_blocks
from slam_observer_ros.geometry import se3
from slam_observer_ros.joint_compatibility import huber_loss, joint_cost
from slam_observer_ros.slam import Sighting, Slam
from slam_observer_ros.types import IntArray


def is_plain(slam: Slam, event: ObservationEvent, sighting: Sighting) -> bool:
    """Return whether there is but one reading of an observation: as it came."""
    if not isinstance(slam.gains, RiccatiGains):
        return True
    has_ids = not (event.ids == UNKNOWN_ID).any()
    return has_ids and not slam.gains.suspects(sighting.innovation).any()


def readings(
    slam: Slam, event: ObservationEvent, new_ids: IntArray, budget: float
) -> list[tuple[ObservationEvent, float]]:
    """Return what an observation may mean.

    Parameters
    ----------
    slam : Slam
        The state at the observation's instant.
    event : ObservationEvent
        The observation, of m points.
    new_ids : IntArray
        (m,) ids of points that are taken for landmarks not seen before.
    budget : float
        Cost beyond which readings need not be returned.

    Returns
    -------
    list of tuple
        The observation with all ids filled in, or without a point that is taken for an outlier;
        and what it costs: −2 ln of its likelihood. As it came and 0 if the gains know no joint
        covariance to judge it by.

    """
    if not isinstance(slam.gains, RiccatiGains):
        return [(event, 0.0)]
    if (event.ids == UNKNOWN_ID).any():
        return _named(slam, slam.gains, event, new_ids, budget)
    sighting = slam.look(event)
    trusting = _cost(slam, slam.gains, event, sighting.innovation)
    found = [(event, trusting)]
    suspects = slam.gains.suspects(sighting.innovation)
    for row in sighting.innovation.indices[suspects]:
        others = select(event, event.ids != slam.landmarks.ids[row])
        cost = _cost(slam, slam.gains, others, slam.look(others).innovation)
        cost += float(huber_loss(slam.settings.rejection_distance))
        found.append((others, max(cost, trusting)))
    return found


def are_one(slam: Slam, other: Slam, event: ObservationEvent) -> bool:
    """Return whether two states have the robot at one place, as far as the points seen tell."""
    here, there = slam.observer.pose, other.observer.pose
    shifts = se3.transform(here, event.points) - se3.transform(there, event.points)
    noise = here[:3, :3] @ slam.noise.observation(event) @ here[:3, :3].T
    return len(shifts) > 0 and bool(np.max(mahalanobis(shifts, noise)) <= RESOLUTION)


def _named(
    slam: Slam, gains: RiccatiGains, event: ObservationEvent, new_ids: IntArray, budget: float
) -> list[tuple[ObservationEvent, float]]:
    """Return the readings of points some of which have no id, the most likely first."""
    ids = slam.landmarks.ids
    found = find_readings(
        slam.observer,
        gains,
        slam.index,
        se3.transform(slam.observer.A, event.points),
        slam.turned(slam.noise.observation(event)),
        slam.landmarks.indices_of(event.ids),
        slam.settings,
        budget,
    )
    events = []
    for reading in found:
        named = np.where(reading.rows < 0, new_ids, np.append(ids, UNKNOWN_ID)[reading.rows])
        named = np.where(event.ids == UNKNOWN_ID, named, event.ids)
        events.append((replace(event, ids=named), reading.cost))
    return events


def _cost(
    slam: Slam, gains: RiccatiGains, event: ObservationEvent, innovation: Innovation
) -> float:
    """Return what it costs to take points for the landmarks whose ids they have."""
    gate, k = slam.settings.rejection_distance, 2 if slam.settings.two_d_mode else 3
    r, noise = innovation.r[:, :k], innovation.covariances[:, :k, :k]
    predicted = gains.foretold(innovation)[1]
    passed = distances(r, predicted, noise) <= gate
    used = np.flatnonzero(np.repeat(passed, k))
    S = with_blocks(predicted[used][:, used], noise[passed])
    unpaired = len(event.ids) - np.sum(passed)
    return joint_cost(r[passed], S, noise[passed]) + float(unpaired * huber_loss(gate))
