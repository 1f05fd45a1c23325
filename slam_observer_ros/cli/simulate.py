"""``slam-observer simulate``: the paper's section VI, without ROS.

The simulation goes through the estimator, and shows how fast its Lyapunov function decreases.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
import math
import os
from pathlib import Path

import numpy as np

from slam_observer_ros.cli.console import print_json, print_table, show_progress
from slam_observer_ros.cli.options import (
    add_settings_options,
    check_directory,
    check_outputs,
    FORCE,
    options,
    read_given,
    settings_of,
    value_of,
)
from slam_observer_ros.common.errors import EvaluationError, OutputError, UsageError
from slam_observer_ros.common.files import destination, unfinished_directory
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.filter.observer import lyapunov
from slam_observer_ros.recordings.trajectory import PoseTruth, Trajectory
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.runs.metrics import Decay, fit_decay
from slam_observer_ros.runs.recorders import PoseSamples
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import from_parameters, table
from slam_observer_ros.simulation import Scenario, SimulatedEvent, Simulation

LYAPUNOV_FLOOR = 1e-40  # L where all residuals are exactly zero, so that its log is finite
ROUNDING_MARGIN = 1e6  # how far above rounding L must be for the slope to be fitted to it


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRun:
    """What came of a simulated run.

    ``lyapunov`` (k,) is L (34) before each correction; ``times_s`` (k,) are since the start. The
    ``decay`` is found by :func:`.fit_decay`. The poses ``estimate`` and ``truth`` have the
    same p stamps, and so have ``landmark_tracks`` (p, n, 3) of the estimate, in its world, metres;
    they are NaN before the first sighting.
    """

    times_s: FloatArray
    lyapunov: FloatArray
    decay: Decay | None
    estimate: Trajectory
    truth: Trajectory
    landmark_tracks: FloatArray

    @property
    def log10_lyapunov(self) -> FloatArray:
        """(k,) log10 L, of :data:`LYAPUNOV_FLOOR` where L is smaller than that."""
        return np.log10(np.maximum(self.lyapunov, LYAPUNOV_FLOOR))


def run_simulation(
    simulation: Simulation, events: Iterable[SimulatedEvent], settings: Settings
) -> SimulatedRun:
    """Run events, as a simulation delivers them, through an estimator with these settings.

    Of each update L is kept and, at most 20 times a second, the configuration.
    """
    levels: dict[int, float] = {}
    samples, landmark_tracks = PoseSamples(), list[FloatArray]()

    def note_update(update: Update) -> None:
        if len(update.ids):
            levels[update.stamp_ns] = update.lyapunov
        stamps_ns = np.array([update.stamp_ns])
        if samples.due(stamps_ns):
            samples.add(stamps_ns, update.pose[None])
            points = np.full((len(simulation.landmark_ids), 3), np.nan)
            points[estimator.landmark_ids] = estimator.world_points
            landmark_tracks.append(points)

    estimator = Estimator(settings, on_update=note_update)
    for event in events:
        if not isinstance(event, PoseTruth):
            estimator.add(event)
    estimator.flush()
    estimate, values = samples.trajectory, np.array(list(levels.values()))
    times_s = to_s(np.array(list(levels)) - simulation.start_ns)
    # L of residuals that are the rounding of the landmarks' coordinates
    rounding = estimator.world_points * np.finfo(np.float64).eps
    floor = ROUNDING_MARGIN * lyapunov(estimator.settings.gain_k, rounding)
    return SimulatedRun(
        times_s,
        values,
        fit_decay(times_s, values, floor),
        estimate,
        Trajectory(estimate.stamps_ns, simulation.pose(estimate.stamps_ns)),
        np.array(landmark_tracks),
    )


START_NS = 1_000_000_000  # stamp of the first event; ROS takes a stamp of zero for an unknown one

MAX_STEP_S = 10.0

MAX_STEPS = 10_000_000  # more of them take days

FIGURES = ('lyapunov', 'configuration')

_SCENARIO_OPTIONS = {
    'seed': 'seed',
    'initial_bias': 'bias',
    'landmark_count': 'landmarks',
    'landmark_distance': 'distance',
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        "Run the paper's simulation (section VI): a robot drives a circle of 5 m "
        'radius and sees landmarks whose first sighting is biased; the observer makes up for it, '
        "with the paper's constant gains if --gains names no others."
    )
    options(
        parser,
        """
        --duration S: simulated seconds (default 80)
        --step S: seconds from one velocity and observation to the next (default 0.02)
        """,
        duration={'default': 80.0},
        step={'default': 0.02},
    )
    rows = {row.name: row for row in table(Scenario)}
    for name, option in _SCENARIO_OPTIONS.items():
        row = rows[name]
        text = row.description[0].lower() + row.description[1:]
        unit = f' [{row.unit}]' if row.unit else ''
        number = 'N' if isinstance(row.default, int) else 'M'
        options(
            parser,
            f'--{option} {number}: {text}{unit} (default {row.default})',
            **{option: {'dest': name, 'type': value_of(row), 'default': row.default}},
        )
    options(
        parser,
        f"""
        --output OUT.mcap: write a recording
        --plot DIR: draw the figures {', '.join(FIGURES)}
        --plot-format: what the figures are written as (default png)
        --json: print one JSON object
        {FORCE}
        """,
        plot_format={'choices': ('png', 'svg', 'pdf'), 'default': 'png'},
    )
    add_settings_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Simulate, and write what was asked for."""
    scenario = _scenario(args)
    # The paper's gains, whatever is the best on real sensors; and each simulated velocity holds
    # until the next one.
    settings = settings_of(
        read_given(args),
        gains='constant',
        velocity_timeout=max(2.0 * args.step, Settings().velocity_timeout),
        max_innovation_time=max(args.step, Settings().max_innovation_time),
    )
    check_outputs({'--output': args.output}, args.force)
    figures = {name: f'{name}.{args.plot_format}' for name in FIGURES}
    if args.plot is not None:
        check_directory(args.plot)
        written = {os.path.realpath(args.plot / name) for name in ('', *figures.values())}
        if args.output is not None and os.path.realpath(args.output) in written:
            raise UsageError(f'{args.output} is named for two outputs')
        if args.plot.is_dir():
            check_outputs({name: args.plot / name for name in figures.values()}, args.force)
    simulation = Simulation(scenario, START_NS)
    result = run_simulation(simulation, _events(simulation, 'simulating'), settings)
    if args.output is not None:
        start_ns = simulation.start_ns
        with RecordingWriter(args.output, overwrite=args.force) as writer:
            writer.write_landmarks(start_ns, simulation.landmark_truth(start_ns))
            for event in _events(simulation, 'recording'):
                writer.write_event(event)
    if args.plot is not None:
        _draw(simulation, result, args.plot, figures)
    if args.json:
        print_json(
            {
                'time_s': result.times_s.tolist(),
                'log10_lyapunov': result.log10_lyapunov.tolist(),
                'slope_per_s': None if result.decay is None else result.decay.slope_per_s,
                'step_s': args.step,
            }
        )
        return
    rows = {
        'simulated': f'{args.duration:g} s in steps of {args.step:g} s',
        'landmarks': str(result.landmark_tracks.shape[1]),
        'log10 L, first': f'{result.log10_lyapunov[0]:.2f}',
        'log10 L, last': f'{result.log10_lyapunov[-1]:.2f}',
        'slope of log10 L': 'none: too few values of L that are more than rounding'
        if result.decay is None
        else f'{result.decay.slope_per_s:.4f} per second after the transient',
    }
    if args.output is not None:
        rows['recording'] = str(args.output)
    if args.plot is not None:
        rows['figures'] = str(args.plot)
    print_table('Simulation', rows)


def _scenario(args: argparse.Namespace) -> Scenario:
    if not 0.0 < args.step <= MAX_STEP_S:
        raise UsageError(f'--step takes seconds above 0, up to {MAX_STEP_S:g}, not {args.step:g}')
    if not args.step <= args.duration < math.inf:
        raise UsageError(
            f'--duration takes seconds, at least one step of {args.step:g}, not {args.duration:g}'
        )
    if args.duration / args.step > MAX_STEPS:
        raise UsageError(
            f'--duration {args.duration:g} in steps of {args.step:g} are more than {MAX_STEPS} '
            'steps; take a shorter one, or longer steps'
        )
    values = {name: getattr(args, name) for name in _SCENARIO_OPTIONS}
    values['duration'] = args.duration
    values['velocity_rate'] = values['observation_rate'] = 1.0 / args.step
    return from_parameters(Scenario, values)


def _events(simulation: Simulation, description: str) -> Iterator[SimulatedEvent]:
    scenario = simulation.scenario
    total = round(scenario.end_s * (2.0 * scenario.velocity_rate + scenario.observation_rate))
    events = (delivery.event for delivery in simulation.deliveries())
    return show_progress(events, description, total)


def _draw(
    simulation: Simulation, result: SimulatedRun, directory: Path, figures: Mapping[str, str]
) -> None:
    """Draw figures, files by name: all are written to a directory, or an OutputError is raised."""
    # matplotlib takes longer to import than the simulation
    from slam_observer_ros.runs.figures import plot_configuration, plot_lyapunov

    # Where L is zero nothing is drawn, rather than the floor.
    log10_lyapunov = np.where(result.lyapunov > 0.0, result.log10_lyapunov, -np.inf)
    tracks, points = result.landmark_tracks, simulation.world_points(simulation.start_ns)
    try:
        with unfinished_directory(directory if directory.is_dir() else directory.parent) as made:
            try:
                plot_lyapunov(
                    made / figures['lyapunov'], result.times_s, log10_lyapunov, result.decay
                )
                path = made / figures['configuration']
                plot_configuration(path, result.estimate, result.truth, tracks, points)
            except EvaluationError as error:  # which names a directory that is gone then
                raise OutputError(str(error).replace(str(made), str(directory))) from error
            directory.mkdir(exist_ok=True)
            for file in sorted(made.iterdir()):
                file.replace(destination(directory / file.name))
    except OSError as error:
        reason = error.strerror or error  # its whole text names a directory that is gone by now
        raise OutputError(f"can't write figures to {directory}: {reason}") from error
