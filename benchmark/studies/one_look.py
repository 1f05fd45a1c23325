"""One look at reflectors without ids, among thousands: how often it says where the robot is.

``python benchmark/studies/one_look.py`` prints, for halls of random reflectors and halls that look
the same from several places, in how many of 200 looks the place was found, and wrong, and the CPU
time of one core. ``--needed`` prints how many points it takes (docs/surveyed_reflectors.md).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import sys
import time

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes, PLANAR, SPATIAL
from slam_observer_ros.mapping.constellation import find_places
from slam_observer_ros.mapping.landmark_map import MappedLandmarks
from slam_observer_ros.mapping.places import Anywhere, Constellation, Place

ERROR_PROBABILITY = 1e-3
DENSITY = 0.03  # reflectors per m²: one in 33 m², as in a hall for laser-guided vehicles
HEIGHT_M = 6.0
RANGE_M = 30.0
SEEN_SHARE = 0.7  # of the reflectors in range; others are hidden
MAPS = 4

SIGMAS_M, FALSE_SHARES, SIZES = (0.02, 0.05, 0.1), (0.0, 0.1, 0.3), (50, 500, 2000)
MOST_POINTS = 14


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table."""

    hall: str
    points: int
    false_share: float
    axes: EstimatedAxes
    landmarks: int = 2000
    sigma_m: float = 0.02

    @property
    def label(self) -> str:
        """What the row is called."""
        space = 'space' if self.axes.point == 3 else 'plane'
        return f'{self.hall}, {space}, {self.points} points, {self.false_share:.0%} false'


CASES = [
    *(
        Case('random', m, share, axes)
        for axes in (PLANAR, SPATIAL)
        for m, share in ((6, 0.1), (8, 0.2), (10, 0.3))
    ),
    Case('regular grid', 8, 0.0, PLANAR),
    Case('regular grid', 8, 0.2, PLANAR),
    Case('same when turned by half', 8, 0.0, PLANAR),
    Case('same when turned by half', 8, 0.2, PLANAR),
]


def hall(case: Case, rng: np.random.Generator) -> FloatArray:
    """Return reflectors (n, 3) in a hall twice as long as wide, metres."""
    n = case.landmarks
    sides_m = np.array([np.sqrt(2.0 * n / DENSITY), np.sqrt(0.5 * n / DENSITY)])
    if case.hall == 'regular grid':
        step_m = DENSITY**-0.5
        x, y = np.meshgrid(*(np.arange(round(side / step_m)) * step_m for side in sides_m))
        points = np.column_stack([x.ravel(), y.ravel()])
    elif case.hall == 'same when turned by half':
        half = rng.uniform(0.0, sides_m, (n // 2, 2))
        points = np.concatenate([half, sides_m - half])
    else:
        points = rng.uniform(0.0, sides_m, (n, 2))
    heights_m = rng.uniform(0.0, HEIGHT_M if case.axes.point == 3 else 0.0, len(points))
    return np.column_stack([points, heights_m])


def look(
    case: Case, reflectors: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return a true pose (4, 4), and the points (m, 3) seen there: some are of no reflector."""
    while True:
        position = rng.uniform(reflectors.min(axis=0), reflectors.max(axis=0))
        turn = rng.uniform(-np.pi, np.pi, 3) if case.axes.turn == 3 else [0.0, 0.0, 0.0]
        pose = se3.pose(so3.exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])), position)
        pose[:3, :3] = so3.exp(np.asarray(turn, dtype=np.float64)) @ pose[:3, :3]
        points = se3.transform(se3.inverse(pose), reflectors)
        ranges_m = np.linalg.norm(points, axis=1)
        seen: IntArray = np.argsort(ranges_m)
        seen = seen[(ranges_m[seen] < RANGE_M) & (rng.random(len(seen)) < SEEN_SHARE)]
        seen = seen[: case.points]
        if len(seen) == case.points:
            break
    points, k = points[seen], case.axes.point
    is_false = rng.random(len(points)) < case.false_share
    anywhere = rng.normal(size=points.shape) * (np.arange(3) < k)
    anywhere *= rng.uniform(0.0, ranges_m[seen].max(), len(points))[:, None] / np.linalg.norm(
        anywhere, axis=1, keepdims=True
    )
    points = np.where(is_false[:, None], anywhere, points)
    noise = rng.normal(scale=case.sigma_m, size=points.shape) * (np.arange(3) < k)
    return pose, points + noise


def is_right(place: Place, pose: FloatArray) -> bool:
    """Return whether a place is within half a metre and a tenth of a radian of the true pose."""
    off = se3.inverse(pose) @ place.transform
    turn_rad = np.linalg.norm(so3.log(off[:3, :3]))
    return bool(np.linalg.norm(off[:3, 3]) < 0.5 and turn_rad < 0.1)


def print_needed(looks: int) -> None:
    """Print how many points it takes in the plane, by noise, false points and size of the map."""
    sys.stdout.write('| σ | false | ' + ' | '.join(f'{n} mapped' for n in SIZES) + ' |\n')
    sys.stdout.write('| --- ' * (2 + len(SIZES)) + '|\n')
    for sigma_m in SIGMAS_M:
        for share in FALSE_SHARES:
            cells = [_needed(sigma_m, share, n, looks) for n in SIZES]
            row = ' | '.join([f'{100 * sigma_m:.0f} cm', f'{share:.0%}', *cells])
            sys.stdout.write(f'| {row} |\n')
            sys.stdout.flush()


def _needed(sigma_m: float, false_share: float, landmarks: int, looks: int) -> str:
    """Return the fewest points by which nine of ten looks are enough."""
    for points in range(4, MOST_POINTS + 1):
        case = Case('random', points, false_share, PLANAR, landmarks, sigma_m)
        if measure(case, looks).right >= 0.9 * looks:
            return str(points)
    return f'> {MOST_POINTS}'


@dataclass(frozen=True, slots=True)
class Figures:
    """What came of some looks."""

    right: int
    wrong: int
    times_s: list[float]


def row(case: Case, looks: int) -> str:
    """Return the row of a case."""
    found = measure(case, looks)
    median_ms, most_ms = 1e3 * float(np.median(found.times_s)), 1e3 * max(found.times_s)
    return (
        f'| {case.label} | {found.right / looks:.1%} | {found.wrong} of {looks} | '
        f'{median_ms:.0f} | {most_ms:.0f} |'
    )


def measure(case: Case, looks: int) -> Figures:
    """Look around in halls of a case."""
    rng = np.random.default_rng(0)
    maps = []
    for _ in range(MAPS):
        reflectors = hall(case, rng)
        covariances = np.tile(1e-6 * np.eye(3), (len(reflectors), 1, 1))
        maps.append(MappedLandmarks(reflectors, covariances, case.axes))
        maps[-1].reach(2.0 * RANGE_M)
    right = wrong = 0
    times_s = []
    for number in range(looks):
        known = maps[number % MAPS]
        pose, points = look(case, known.points, rng)
        covariance = case.sigma_m**2 * np.eye(case.axes.point * len(points))
        seen = Constellation(points, covariance, np.full(len(points), -1))
        start_s = time.process_time()
        places = find_places(known, seen, Anywhere(known), ERROR_PROBABILITY)
        times_s.append(time.process_time() - start_s)
        place = places.decided(ERROR_PROBABILITY)
        if place is not None:
            right += is_right(place, pose)
            wrong += not is_right(place, pose)
    return Figures(right, wrong, times_s)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--looks', type=int, default=200, help='in each case')
    parser.add_argument('--needed', action='store_true', help='print how many points it takes')
    args = parser.parse_args()
    looks = args.looks
    if args.needed:
        print_needed(looks)
        return
    sys.stdout.write(
        '| 2000 reflectors, σ 2 cm | found | wrong | CPU, median, ms | at most, ms |\n'
    )
    sys.stdout.write('| --- | --- | --- | --- | --- |\n')
    for case in CASES:
        sys.stdout.write(row(case, looks) + '\n')
        sys.stdout.flush()


if __name__ == '__main__':
    main()
