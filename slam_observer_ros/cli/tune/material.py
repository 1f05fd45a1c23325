"""The recordings of a tuning: what is trained on, and what is held out."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam_observer_ros.cli.options import add_settings_options, named_path
from slam_observer_ros.cli.outputs import add_force_option
from slam_observer_ros.cli.replay.request import add_input_options, ReplayRequest
from slam_observer_ros.cli.replay.run import select_inputs
from slam_observer_ros.cli.replay.summary import sha256_of
from slam_observer_ros.cli.tune.verdict import Judged
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import Event, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.recorded_truth import Truth
from slam_observer_ros.runs.likelihood import Likelihood, LikelihoodRecorder
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.input_settings import InputSettings

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
        """Return that of the part to train on."""
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
        if not estimator.is_localised:
            raise UsageError(
                f'{self.path}: the pose in the map was not found: {estimator.localisation_problem}'
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


def check_seen(judged: Iterable[Judged]) -> None:
    """Raise a UsageError if there is nothing to judge in what was held out."""
    if not all(len(one.likelihood.stamps_ns) for one in judged):
        raise UsageError('nothing is seen twice in what is held out')


def add_material_options(
    parser: argparse.ArgumentParser, trained_on: str, *out_flags: str
) -> None:
    """Add what is held out beside what is ``trained_on``, and the parameter file that results."""
    parser.add_argument(
        '--hold-out',
        action='append',
        default=[],
        type=named_path,
        metavar='RECORDING',
        help=f'hold this one out, and {trained_on}; may be given several times',
    )
    outputs = parser.add_argument_group('outputs')
    outputs.add_argument(
        *out_flags,
        type=named_path,
        metavar='FILE',
        help='parameter file to write if it is an improvement',
    )
    outputs.add_argument('--json', action='store_true', help='print one JSON object')
    add_force_option(parser)
    add_input_options(parser)
    add_settings_options(parser, InputSettings)
    parser.set_defaults(smooth=False, load_map=None)
