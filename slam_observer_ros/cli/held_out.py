"""What is held out of recordings, and whether what was found on the rest holds there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np

from slam_observer_ros.cli.replay_request import ReplayRequest, select_inputs
from slam_observer_ros.common.errors import IncompleteError, UsageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import Event, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.opening import sha256_of
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.trajectory import Truth
from slam_observer_ros.runs.accuracy import Likelihood, LikelihoodRecorder
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings

BLOCKS = 20
"""Parts of a recording in time by which it is judged whether a gain may be chance."""

SURE = 2.0
"""Standard deviations by which the likelihood must grow."""

WORSE_ERROR = 1.05
WORSE_CONSISTENCY = 1.5
"""Factors by which the error, or how far the ANEES is from 1, may grow."""


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """How settings do on what was held out; errors are None where the truth is not known."""

    likelihood: Likelihood
    configuration_rmse_m: float | None
    configuration_anees: float | None


@dataclass(frozen=True, slots=True)
class Verdict:
    """Figures of what was held out, before and after; the ``objection`` is '' if all is better.

    Log likelihoods are per observation; errors are root mean squares over the recordings, and
    ANEES means; None where the truth is not known.
    """

    log_likelihood: tuple[float, float]
    gain: float
    gain_deviation: float
    error_m: tuple[float, float] | None
    anees: tuple[float, float] | None
    objection: str


def judge(before: Sequence[Judged], after: Sequence[Judged]) -> Verdict:
    """Compare settings on the recordings that were held out, in the same order."""
    pairs = [(one.likelihood, other.likelihood) for one, other in zip(before, after, strict=True)]
    gains = np.concatenate([_block_gains(*pair) for pair in pairs])
    gain, deviation = float(gains.sum()), float(np.std(gains) * math.sqrt(len(gains)))
    error_m = _pair(
        _root_mean_square(judged.configuration_rmse_m for judged in one) for one in (before, after)
    )
    anees = _pair(_mean(judged.configuration_anees for judged in one) for one in (before, after))
    return Verdict(
        (_per_observation(pairs, 0), _per_observation(pairs, 1)),
        gain,
        deviation,
        error_m,
        anees,
        _objection(gain, deviation, error_m, anees),
    )


def _objection(
    gain: float,
    deviation: float,
    error_m: tuple[float, float] | None,
    anees: tuple[float, float] | None,
) -> str:
    if not gain > SURE * deviation:
        return f'the log likelihood changes by {gain:.1f} ± {deviation:.1f}, which may be chance'
    if error_m is not None and error_m[1] > WORSE_ERROR * error_m[0]:
        return f'the error grows from {error_m[0]:.3g} to {error_m[1]:.3g} m'
    if anees is not None:
        off = [abs(math.log(value)) for value in anees]
        if off[1] > off[0] + math.log(WORSE_CONSISTENCY):
            return f'the ANEES goes from {anees[0]:.2g} to {anees[1]:.2g}, away from 1'
    return ''


def _block_gains(before: Likelihood, after: Likelihood) -> FloatArray:
    """Return by how much the log likelihood grows in each of some parts of a recording."""
    stamps_ns = np.concatenate([before.stamps_ns, after.stamps_ns])
    edges = np.linspace(stamps_ns.min(), stamps_ns.max() + 1, BLOCKS + 1)
    totals = [
        np.histogram(one.stamps_ns, edges, weights=one.shares * one.log_densities)[0]
        for one in (before, after)
    ]
    return np.asarray(totals[1] - totals[0], dtype=np.float64)


def _per_observation(pairs: Sequence[tuple[Likelihood, Likelihood]], which: int) -> float:
    parts = [pair[which] for pair in pairs]
    return sum(part.total for part in parts) / sum(part.count for part in parts)


def _pair(values: Iterable[float | None]) -> tuple[float, float] | None:
    before, after = values
    return None if before is None or after is None else (before, after)


def _root_mean_square(values: Iterable[float | None]) -> float | None:
    mean = _mean(None if value is None else value**2 for value in values)
    return None if mean is None else math.sqrt(mean)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def verdict_lines(verdict: Verdict) -> dict[str, str]:
    """Return what was found on what was held out, before → after."""
    before, after = verdict.log_likelihood
    lines = {
        'log likelihood per observation': f'{before:.3f} → {after:.3f}',
        'log likelihood, gain': f'{verdict.gain:.1f} ± {verdict.gain_deviation:.1f}',
    }
    if verdict.error_m is not None:
        lines['configuration error, RMS'] = '{:.3f} → {:.3f} m'.format(*verdict.error_m)
    if verdict.anees is not None:
        lines['ANEES of the configuration'] = '{:.2f} → {:.2f}'.format(*verdict.anees)
    return lines


def judged_lines(held_out: Sequence[str], verdict: Verdict) -> list[str]:
    """Return what the head of a file says of what was held out."""
    return [
        'held out:',
        *(f'  {name}' for name in held_out),
        *(f'  {name}: {text}' for name, text in verdict_lines(verdict).items()),
    ]


HELD_OUT_SHARE = 1.0 / 3.0
"""Part of a recording, at its end, that is held out where no other recording is."""


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """A recording's events; those from ``split_ns`` on are held out, of what is trained on."""

    path: Path
    sha256: str
    events: Sequence[Event]
    truth: Truth
    reach_m: float
    split_ns: int
    landmark_map: LandmarkMap | None = None

    def likelihood(self, settings: Settings) -> Likelihood:
        """Return the figure of the part to train on."""
        return self.trained(settings)[1]

    def trained(self, settings: Settings) -> tuple[Estimator, Likelihood]:
        """Return what comes of the part to train on; a UsageError if it is not in the map."""
        recorder = self._recorder(settings)
        estimator = Estimator(settings, on_update=recorder.note_update, judges_innovations=True)
        if self.landmark_map is not None:
            estimator.load_map(self.landmark_map)
        for event in self.events:
            if event.stamp_ns < self.split_ns:
                estimator.add(event)
        estimator.flush()
        if problem := estimator.localisation_problem:
            raise UsageError(
                f'{self.path}: the pose in the map was not found: {problem.what}; {problem.remedy}'
            )
        return estimator, recorder.likelihood

    def judged(self, settings: Settings) -> Judged:
        """Return how settings do on the part that is held out, after all that was before it."""
        recorder, is_held_out = self._recorder(settings), self.truth.stamps_ns >= self.split_ns
        stamps_ns, poses = self.truth.stamps_ns[is_held_out], self.truth.poses[is_held_out]
        truth = replace(self.truth, stamps_ns=stamps_ns, poses=poses)
        result = replay(self.events, settings, truth, self.landmark_map, recorders=[recorder])
        likelihood = recorder.likelihood
        return Judged(
            likelihood.select(likelihood.stamps_ns >= self.split_ns),
            result.configuration.rmse_m,
            result.configuration.anees,
        )

    def _recorder(self, settings: Settings) -> LikelihoodRecorder:
        return LikelihoodRecorder(axes_of(settings.two_d_mode).point, self.reach_m)


def read_material(
    request: ReplayRequest, held_out_share: float, landmark_map: LandmarkMap | None = None
) -> Material:
    """Read a recording; its last part is to be held out."""
    path = request.recording
    with Recording(path) as recording:
        selected, inputs, truth = select_inputs(request, recording)
        events = list(recording.events(selected, inputs, request.settings.velocity_timeout))
    seen = [event for event in events if isinstance(event, ObservationEvent) and len(event.ids)]
    if not seen:
        raise UsageError(f'{path}: no landmark is seen')
    ids = np.concatenate([event.ids for event in seen])
    if 2 * np.count_nonzero(ids == UNKNOWN_ID) > len(ids):
        raise UsageError(
            f'{path}: it needs landmarks with ids: without, what is taken for which depends on '
            'the noise itself'
        )
    stamps_ns = [event.stamp_ns for event in events]
    first_ns, last_ns = min(stamps_ns), max(stamps_ns)
    split_ns = last_ns + 1 - round(held_out_share * (last_ns + 1 - first_ns))
    reach_m = max(float(np.linalg.norm(event.points, axis=1).max()) for event in seen)
    digest = sha256_of(path)
    return Material(path, digest, events, truth, reach_m, split_ns, landmark_map)


def read_held_out(
    requests: Sequence[ReplayRequest],
    paths: Iterable[Path],
    landmark_map: LandmarkMap | None = None,
) -> Iterator[list[Material]]:
    """Read recordings that are held out, one after the other, each as all requests have it."""
    for path in paths:
        yield [
            read_material(replace(request, recording=path), 1.0, landmark_map)
            for request in requests
        ]


def judged_by(
    settings: Sequence[Settings], held_out: Iterable[Sequence[Material]]
) -> list[list[Judged]]:
    """Return how each of some settings does on all recordings, in their order.

    Of each recording ``held_out`` has what is read for each of the settings. Raises a UsageError
    if there is nothing to judge.
    """
    rows = [
        [material.judged(one) for one, material in zip(settings, materials, strict=True)]
        for materials in held_out
    ]
    if not all(len(judged.likelihood.stamps_ns) for row in rows for judged in row):
        raise UsageError('nothing is seen twice in what is held out')
    return [list(column) for column in zip(*rows, strict=True)]


def check_improvement(verdict: Verdict) -> None:
    """Raise an IncompleteError if what was held out does not confirm what was found."""
    if verdict.objection:
        raise IncompleteError(f'no improvement: on what was held out {verdict.objection}')
