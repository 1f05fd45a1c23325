"""``slam-observer calibrate``: mount, scales, biases, delay and noise of sensor and odometry."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace

from slam_observer_ros.cli.calibration_finder import Finder, growth
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
    add_material_options,
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
from slam_observer_ros.cli.noise_tuning import certainty
from slam_observer_ros.cli.options import Given, named_path, read_given
from slam_observer_ros.cli.outputs import (
    check_inputs_are_kept,
    check_outputs,
)
from slam_observer_ros.cli.replay_request import read_request, ReplayRequest, select_inputs
from slam_observer_ros.common import __version__
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.known_map.map_file import read_map
from slam_observer_ros.recording.opening import files_of
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.runs.health import of_mounting, of_noise
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
    parser.add_argument('recording', type=named_path, metavar='RECORDING')
    parser.add_argument(
        '--map',
        dest='survey',
        type=named_path,
        metavar='SURVEY.yaml',
        help='map file of surveyed landmarks',
    )
    parser.add_argument(
        '--keep-noise',
        action='store_true',
        help='leave the noise of points as it is stated, which takes a third of the time',
    )
    add_material_options(parser, 'take all of the other', '-o', '--out')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Calibrate by a recording, and judge on what was held out."""
    given = read_given(args)
    request = read_request(args, given, args.recording)
    request.need_errors('calibrate')
    read = {f'the recording {path}': files_of(path) for path in (args.recording, *args.hold_out)}
    survey = None
    if args.survey is not None:
        read['the map'] = [args.survey]
        survey = read_map(args.survey)
        if request.settings.localization_mode == 'off':
            request = request.with_values({'localization_mode': 'uncertain'})
    check_inputs_are_kept({'--out': args.out}, read)
    check_outputs([args.out], args.force)
    share = 0.0 if args.hold_out else HELD_OUT_SHARE
    material = read_material(request, share, survey)
    # What the settings that are tried give reason to warn of is nobody's concern.
    with muted_warnings(), shown_steps('calibrating') as advance:
        found = Finder(material, request.settings, given.assigned, advance).find(args.keep_noise)
        pose = _sensor_pose(request, found)
        stated = state_found(request.settings, request.inputs, found, pose)
        noisy = with_noise(stated, found, not _states_motion(material))
        corrected = replace(request, inputs=stated.inputs)
        trained_on = read_material(corrected, share, survey)
        held_out: Iterable[Sequence[Material]] = [(material, trained_on)]
        if args.hold_out:
            held_out = read_held_out((request, corrected), args.hold_out, survey)
        before, after, after_noise = judged_by(
            [request.settings, stated.settings, noisy.settings],
            ((as_given, as_found, as_found) for as_given, as_found in held_out),
        )
        if not judge(after, after_noise).objection:  # else the noise is left as it was
            stated, after = noisy, after_noise
        verdict = judge(before, after)
        gain = growth(
            material.likelihood(request.settings), trained_on.likelihood(stated.settings)
        )
    _print(args, material, found, stated, gain, verdict)
    check_improvement(verdict)
    if args.out is not None:
        _write(args, given, material, stated, gain, verdict)


def _sensor_pose(request: ReplayRequest, found: Found) -> FloatArray | None:
    """Return the pose (4, 4) of the only sensor; None if there are several, or it moves."""
    if len(found.frames) != 1:
        return None
    with Recording(request.recording) as recording:
        selected, inputs, _ = select_inputs(request, recording)
        return recording.sensor_pose(selected, inputs, next(iter(found.frames)))


def _states_motion(material: Material) -> bool:
    """Return whether some velocities come with their covariances."""
    return any(
        event.covariance is not None
        for event in material.events
        if isinstance(event, VelocityEvent)
    )


def _print(
    args: argparse.Namespace,
    material: Material,
    found: Found,
    stated: Stated,
    gain: tuple[float, float],
    verdict: Verdict,
) -> None:
    """Print what was found, how well it is known, and how it does on what was held out."""
    parameters = {name: value for _, values in stated.groups for name, value in values.items()}
    if args.json:
        print_json(
            {
                'recording': str(args.recording),
                'recording_sha256': material.sha256,
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
                'log_likelihood_gain': gain,
                'noise_log_factors': {kind.name: [log, d] for kind, log, d in found.noise},
                'motion_factors': {part.name: asdict(part) for part in found.factors},
                'parameters': parameters,
                'held_out': asdict(verdict),
            }
        )
        return
    rows = [
        [part.name, str(part), looked_for(part), f'{100.0 * part.deviation / part.stated:.0f} %']
        for part in found.parts
    ]
    print_columns(str(args.recording), ['', 'found', 'looked for within', 'σ is left'], rows)
    lines = {'ranges': depth_text(found)}
    lines |= {f'noise of {kind.name}': certainty(log, d) for kind, log, d in found.noise}
    lines |= {f'noise of {part.name}': str(part) for part in found.factors}
    to_do = [*of_mounting(found.parts), *of_noise(found.factors)]
    lines |= {f'to do: {finding.what}': finding.remedy for finding in to_do}
    lines |= _open_questions(found)
    lines['log likelihood, gain'] = '{:.1f} ± {:.1f}'.format(*gain)
    lines |= {f'held out: {name}': text for name, text in verdict_lines(verdict).items()}
    print_table('what it says', lines)


def _open_questions(found: Found) -> dict[str, str]:
    """Return what the recording says little of, and why."""
    unseen = [part.name for part in found.parts if not is_seen(part)]
    lines = {'not seen': f'{", ".join(unseen)}: left as stated'} if unseen else {}
    if found.too_noisy:
        lines['too noisy'] = f'velocities for their scale: {", ".join(found.too_noisy)}'
    for number, trade in enumerate(found.trades, 1):
        lines[f'trade {number}'] = trade.text
    return lines


def _write(
    args: argparse.Namespace,
    given: Given,
    material: Material,
    stated: Stated,
    gain: tuple[float, float],
    verdict: Verdict,
) -> None:
    """Write the parameter file."""
    held_out = [str(path) for path in args.hold_out] or ['the last third']
    where = 'the map being made' if args.survey is None else f'the map {args.survey.name}'
    head = [
        f'By slam-observer calibrate {__version__} from',
        f'  {material.path.name} (SHA-256 {material.sha256}) in {where}',
        'log likelihood, gain: {:.1f} ± {:.1f}'.format(*gain),
        *judged_lines(held_out, verdict),
        'Values ± their standard deviations; what the recording says little of is as it was.',
    ]
    write_found(args.out, head, given.values, stated.groups)
