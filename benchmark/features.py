"""What features are worth: each with and without, on runs of the kind that it is meant for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
import math
from typing import Any, TypeAlias

from estimators import observer, run_online
import outliers
from scores import FAILED, score, Scores
import slips
import worlds
from worlds import Loop, World

DRAWS = 5
"""Runs of each kind: the robots of MRCLAM 6, starts of Starry Night, seeds of a loop."""

STARTS_S = 30.0
"""Time from one start of Starry Night to the next."""

WHEELED, STEREO = worlds.WHEELED_LOOP, worlds.STEREO_LOOP
SMALL = Loop('wheeled_bearing_range', 60.0, 180.0, 20, 6.0, 2)
SMALL_STEREO = Loop('stereo_inertial', 60.0, 180.0, 20, 6.0, 5)
"""In small loops landmarks are soon seen again."""

MOVING_SHARE = 0.1

NEVER_RELINEARISED = {'relinearization_interval': 0}
NO_SLIPS = {'unknown_angular_motion': 0.0, 'unknown_linear_motion': 0.0}
"""It has no other effect here: velocities have no gaps for which these figures count."""

VELOCITIES = {'landmark_velocity_stddev': 0.04}
"""Root mean square of each component over all landmarks, a tenth of which move."""

Make: TypeAlias = Callable[[int], World]
Change: TypeAlias = Callable[[World, int], World]


@dataclass(frozen=True, slots=True)
class Case:
    """A feature on runs of one kind.

    Attributes
    ----------
    make : callable
        Gives the run of a draw.
    change : callable
        Does to a part of the run, by its draw, what the feature is there for.
    on, off : dict
        Settings with the feature and without it.

    """

    make: Make
    change: Change
    on: dict[str, Any]
    off: dict[str, Any]


def names() -> list[str]:
    """Return the names of all cases; real recordings if they are there."""
    return [name for name in _CASES if worlds.data_folder().is_dir() or 'loop' in name]


def with_and_without(
    name: str, draw: int, from_s: float = 0.0, to_s: float = math.inf
) -> tuple[Scores, Scores]:
    """Return the scores of Riccati gains with a feature and without it."""
    case = _CASES[name]
    part = case.make(draw).part(from_s, to_s)
    if not part.events:
        return FAILED, FAILED
    world = case.change(part, draw)
    return _scores(world, case.on), _scores(world, case.off)


def _scores(world: World, changes: dict[str, Any]) -> Scores:
    estimator = observer('riccati')(replace(world.settings, **changes))
    return score(run_online(estimator, world.events), world)


def _mrclam(draw: int) -> World:
    return _load(f'MRCLAM 6, robot {draw + 1}')


def _starry_night(draw: int) -> World:
    return _load('Starry Night').part(draw * STARTS_S, math.inf)


def _drive(loop: Loop, draw: int) -> World:
    return worlds.drive(loop, worlds.simulated_settings(loop.config), draw)


def _as_it_is(world: World, _draw: int) -> World:
    return world


def _known_at_rest(world: World, _draw: int) -> World:
    return world.known_at_rest()


@cache
def _load(name: str) -> World:
    return worlds.load(name)


_RUNS: dict[str, Make] = {
    'Starry Night': _starry_night,
    'MRCLAM 6': _mrclam,
    'loop, 3D stereo': partial(_drive, STEREO),
    'loop, wheeled': partial(_drive, WHEELED),
    'small loop, wheeled': partial(_drive, SMALL),
}

_MISHAPS: dict[str, Change] = {
    'with slips': slips.with_slips,
    'with slips in the dark': partial(slips.with_slips, unseen_s=slips.UNSEEN_S),
    'carried': slips.carried,
    '5 % outliers': outliers.with_outliers,
}

_MOVING: dict[str, Make] = {
    name: partial(_drive, replace(loop, moving_share=MOVING_SHARE))
    for name, loop in (
        ('loop, wheeled', WHEELED),
        ('small loop, wheeled', SMALL),
        ('small loop, 3D stereo', SMALL_STEREO),
    )
}

_CASES: dict[str, Case] = {
    **{
        f'relinearising online: {run}': Case(make, _as_it_is, {}, NEVER_RELINEARISED)
        for run, make in _RUNS.items()
    },
    **{
        f'slips: {run}, {how}': Case(_RUNS[run], change, {}, NO_SLIPS)
        for run in ('MRCLAM 6', 'loop, wheeled', 'small loop, wheeled')
        for how, change in _MISHAPS.items()
        if not (run == 'MRCLAM 6' and how == 'carried')  # it does not drive on all the time
    },
    **{
        f'landmark velocities: {run}, a tenth moves{which}': Case(make, change, VELOCITIES, {})
        for run, make in _MOVING.items()
        for which, change in (('', _as_it_is), ('; error of those at rest', _known_at_rest))
    },
}
