"""``slam-observer calibrate``: mount, scales, biases, delay and noise of sensor and odometry."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from slam_observer_ros.cli.calibration_finder import CalibrationFinder, find_noise, growth
from slam_observer_ros.cli.calibration_stated import (
    depth_text,
    Found,
    is_off,
    is_seen,
    looked_for,
    state_found,
    Stated,
    with_noise,
)
from slam_observer_ros.cli.console import (
    muted_warnings,
    print_columns,
    print_json,
    print_table,
    shown_steps,
)
from slam_observer_ros.cli.held_out import (
    check_improvement,
    HELD_OUT_SHARE,
    judge,
    judged_by,
    judged_lines,
    Material,
    read_held_out,
    read_material,
    Verdict,
    verdict_lines,
)
from slam_observer_ros.cli.options import add_settings_options, Given, named_path, read_given
from slam_observer_ros.cli.outputs import add_force_option, check_inputs_are_kept, check_outputs
from slam_observer_ros.cli.replay_request import (
    add_input_options,
    read_request,
    ReplayRequest,
    select_inputs,
)
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.recordings.opening import files_of
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.runs.health import of_mounting, of_noise
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_file import write_found


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Find how the sensor of landmarks is mounted, the scale of its ranges, or whether they '
        'are depths, the delay, scales and biases of the velocities, and the noise of points: '
        'what makes a drive most likely. In a surveyed map all of it is found, without one not '
        'the scales. What --set states of a standard deviation is kept. What is found must hold '
        'on what was held out: the last third, or other recordings. If it does not, no file is '
        'written, and the exit code is 4.'
    )
    parser.add_argument(
        'recordings',
        nargs='+',
        type=named_path,
        metavar='RECORDING',
        help='a drive; for --only noise it may be several, driven for anything else',
    )
    parser.add_argument(
        '--map',
        dest='survey',
        type=named_path,
        metavar='SURVEY.yaml',
        help='map file of surveyed landmarks',
    )
    searched = parser.add_mutually_exclusive_group()
    searched.add_argument(
        '--only',
        choices=('noise',),
        help='find the noise of points and velocities, and leave all else as it is stated',
    )
    searched.add_argument(
        '--keep-noise',
        action='store_true',
        help='leave the noise of points as it is stated, which takes a third of the time',
    )
    parser.add_argument(
        '--hold-out',
        action='append',
        default=[],
        type=named_path,
        metavar='RECORDING',
        help='hold this one out, and take all of the others; may be given several times',
    )
    outputs = parser.add_argument_group('outputs')
    outputs.add_argument(
        '-o',
        '--out',
        type=named_path,
        metavar='FILE',
        help='parameter file to write if it is an improvement',
    )
    outputs.add_argument('--json', action='store_true', help='print one JSON object')
    add_force_option(parser)
    add_input_options(parser)
    add_settings_options(parser, InputSettings)
    parser.set_defaults(smooth=False, load_map=None, run=run)


def run(args: argparse.Namespace) -> None:
    """Calibrate by some recordings, and judge on what was held out."""
    if len(args.recordings) > 1 and args.only is None:
        raise UsageError('a calibration is of one drive; give several recordings to --only noise')
    given = read_given(args)
    request = read_request(args, given, args.recordings[0])
    request.need_errors('calibrate')
    read = {f'the recording {p}': files_of(p) for p in (*args.recordings, *args.hold_out)}
    survey = None
    if args.survey is not None:
        read['the map'] = [args.survey]
        survey = read_map(args.survey)
        if request.settings.localization_mode == 'off':
            request = request.with_values({'localization_mode': 'uncertain'})
    check_inputs_are_kept({'--out': args.out}, read)
    check_outputs([args.out], args.force)
    materials = _materials(args, request, survey)
    # What the settings that are tried give reason to warn of is nobody's concern.
    with muted_warnings(), shown_steps('calibrating') as advance:
        found = _found(args, request, materials, given, advance)
        pose = _sensor_pose(request, found)
        stated = state_found(request.settings, request.inputs, found, pose)
        noisy = with_noise(stated, found, not _states_motion(materials))
        corrected = replace(request, inputs=stated.inputs)
        trained_on = materials
        if corrected != request:
            trained_on = [_read(args, corrected, path, survey) for path in args.recordings]
        before, after, after_noise = judged_by(
            [request.settings, stated.settings, noisy.settings],
            _held_out(args, (request, corrected), materials, trained_on, survey),
        )
        # Noise that is found beside other things is left as it was if it is no improvement.
        if args.only == 'noise' or not judge(after, after_noise).objection:
            stated, after = noisy, after_noise
        verdict = judge(before, after)
        gain = growth(
            [material.likelihood(request.settings) for material in materials],
            [material.likelihood(stated.settings) for material in trained_on],
        )
    result = _Result(request.settings, materials, found, stated, gain, verdict)
    _print(args, result)
    check_improvement(verdict)
    if args.out is not None:
        _write(args, given, result)


@dataclass(frozen=True, slots=True, eq=False)
class _Result:
    """What came of a calibration; the ``gain`` of the log likelihood has its deviation."""

    before: Settings
    materials: Sequence[Material]
    found: Found
    stated: Stated
    gain: tuple[float, float]
    verdict: Verdict


def _read(
    args: argparse.Namespace, request: ReplayRequest, path: Path, survey: LandmarkMap | None
) -> Material:
    share = 0.0 if args.hold_out else HELD_OUT_SHARE
    return read_material(replace(request, recording=path), share, survey)


def _materials(
    args: argparse.Namespace, request: ReplayRequest, survey: LandmarkMap | None
) -> list[Material]:
    """Read what is trained on; what is held out is only looked at, before the long search."""
    with muted_warnings():  # they are shown when it is judged
        held_out = (one for (one,) in read_held_out([request], args.hold_out))
        hashes = [material.sha256 for material in held_out]
    materials = [_read(args, request, path, survey) for path in args.recordings]
    hashes += [material.sha256 for material in materials]
    if len(set(hashes)) < len(hashes):
        raise UsageError('a recording is given twice; what is trained on can not be held out, too')
    return materials


def _found(
    args: argparse.Namespace,
    request: ReplayRequest,
    materials: Sequence[Material],
    given: Given,
    advance: Callable[[], None],
) -> Found:
    if args.only == 'noise':
        return find_noise(materials, request.settings, advance)
    finder = CalibrationFinder(materials[0], request.settings, given.assigned, advance)
    return finder.find(args.keep_noise)


def _held_out(
    args: argparse.Namespace,
    requests: tuple[ReplayRequest, ReplayRequest],
    materials: Sequence[Material],
    trained_on: Sequence[Material],
    survey: LandmarkMap | None,
) -> Iterator[tuple[Material, Material, Material]]:
    """Yield each recording that is held out, as given, as found, and as found with its noise."""
    pairs: Iterable[Sequence[Material]] = zip(materials, trained_on, strict=True)
    if args.hold_out:
        pairs = read_held_out(list(dict.fromkeys(requests)), args.hold_out, survey)
    for pair in pairs:
        yield pair[0], pair[-1], pair[-1]


def _sensor_pose(request: ReplayRequest, found: Found) -> FloatArray | None:
    """Return the pose (4, 4) of the only sensor; None if there are several, or it moves."""
    if len(found.frames) != 1:
        return None
    with Recording(request.recording) as recording:
        selected, inputs, _ = select_inputs(request, recording)
        return recording.sensor_pose(selected, inputs, next(iter(found.frames)))


def _states_motion(materials: Sequence[Material]) -> bool:
    """Return whether some velocities come with their covariances."""
    return any(
        event.covariance is not None
        for material in materials
        for event in material.events
        if isinstance(event, VelocityEvent)
    )


def _print(args: argparse.Namespace, result: _Result) -> None:
    """Print what was found, how well it is known, and how it does on what was held out."""
    found, verdict = result.found, result.verdict
    if args.json:
        print_json(_as_json(args, result))
        return
    title = ', '.join(str(path) for path in args.recordings)
    rows = [
        [part.name, str(part), looked_for(part), f'{100.0 * part.deviation / part.stated:.0f} %']
        for part in found.parts
    ]
    if rows:
        print_columns(title, ['', 'found', 'looked for within', 'σ is left'], rows)
    lines = {} if args.only == 'noise' else {'ranges': depth_text(found)}
    for factor in found.noise:
        lines[f'noise of {factor.kind.name}'] = str(factor)
        for name in factor.kind.parameters:
            before, after = (getattr(one, name) for one in (result.before, result.stated.settings))
            lines[name] = f'{before} → {after}'
    lines |= {f'noise of {part.name}': str(part) for part in found.factors}
    to_do = [*of_mounting(found.parts), *of_noise(found.factors)]
    lines |= {f'to do: {finding.what}': finding.remedy for finding in to_do}
    lines |= _open_questions(found)
    lines['log likelihood, gain'] = '{:.1f} ± {:.1f}'.format(*result.gain)
    lines |= {f'held out: {name}': text for name, text in verdict_lines(verdict).items()}
    print_table('what it says' if rows else title, lines)


def _as_json(args: argparse.Namespace, result: _Result) -> dict[str, object]:
    found = result.found
    parameters = {
        name: value for _, values in result.stated.groups for name, value in values.items()
    }
    return {
        'recordings': {str(material.path): material.sha256 for material in result.materials},
        'version': __version__,
        'map': None if args.survey is None else str(args.survey),
        'calibration': {
            part.name: asdict(part)
            | {'seen': part.deviation / part.stated, 'is_off': is_off(part)}
            for part in found.parts
        },
        'trades': [asdict(trade) for trade in found.trades],
        'range_is_depth': found.range_is_depth,
        'depth_gain': found.depth_gain,
        'log_likelihood_gain': result.gain,
        'noise_log_factors': {one.kind.name: [one.log, one.deviation] for one in found.noise},
        'motion_factors': {part.name: asdict(part) for part in found.factors},
        'parameters': parameters,
        'held_out': asdict(result.verdict),
    }


def _open_questions(found: Found) -> dict[str, str]:
    """Return what the recording says little of, and why."""
    unseen = [part.name for part in found.parts if not is_seen(part)]
    lines = {'not seen': f'{", ".join(unseen)}: left as stated'} if unseen else {}
    if found.too_noisy:
        lines['too noisy'] = f'velocities for their scale: {", ".join(found.too_noisy)}'
    for number, trade in enumerate(found.trades, 1):
        lines[f'trade {number}'] = trade.text
    return lines


def _write(args: argparse.Namespace, given: Given, result: _Result) -> None:
    """Write the parameter file."""
    held_out = [str(path) for path in args.hold_out] or ['the last third']
    where = 'the map being made' if args.survey is None else f'the map {args.survey.name}'
    head = [
        f'By slam-observer calibrate {__version__} in {where} from',
        *(f'  {one.path.name} (SHA-256 {one.sha256})' for one in result.materials),
        'log likelihood, gain: {:.1f} ± {:.1f}'.format(*result.gain),
        *judged_lines(held_out, result.verdict),
        'Values ± their standard deviations; what the recording says little of is as it was.',
        'Intervals of noise are of 95 %, by the curvature of the likelihood, as if all',
        'innovations were independent: errors that last make them too narrow.',
    ]
    write_found(args.out, head, given.values, result.stated.groups)
