"""``slam-observer calibrate``: mount, scales, biases, delay and noise of sensor and odometry.

What a recording shows (``runs/calibration.py``) is stated as parameters, beside what it can't
distinguish.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slam_observer_ros.cli.console import print_columns, print_json, print_table, progress_bar
from slam_observer_ros.cli.options import (
    add_input_options,
    add_settings_options,
    check_outputs,
    FORCE,
    Given,
    options,
    read_given,
    read_request,
)
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import IncompleteError, UsageError
from slam_observer_ros.common.findings import muted_warnings
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.models.calibration import BIAS_OF_RANGES, Entry, OF_SENSOR, OF_VELOCITY
from slam_observer_ros.recordings.opening import files_of
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.runs.calibration import (
    CalibrationFinder,
    find_noise,
    Found,
    growth,
    HELD_OUT_SHARE,
    judge,
    kinds_of,
    Material,
    NoiseFactor,
    read_material,
    rounded,
    scaled,
    Verdict,
)
from slam_observer_ros.runs.health import of_mounting, of_noise
from slam_observer_ros.runs.result import Request
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_file import write_found
from slam_observer_ros.settings.parameter_table import Pose6


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
    options(
        parser,
        """
        recordings RECORDING: a drive; for --only noise it may be several, driven for anything else
        --map SURVEY.yaml: map file of surveyed landmarks
        """,
        recordings={'nargs': '+'},
        map={'dest': 'survey'},
    )
    options(
        parser.add_mutually_exclusive_group(),
        """
        --only: find the noise of points and velocities, and leave all else as it is stated
        --keep-noise: leave the noise of points as it is stated, which takes a third of the time
        """,
        only={'choices': ('noise',)},
    )
    options(
        parser,
        """
        --hold-out RECORDING: hold this one out, and take all of the others; may be given several
            times
        """,
        hold_out={'action': 'append', 'default': []},
    )
    options(
        parser.add_argument_group('outputs'),
        """
        -o --out FILE: parameter file to write if it is an improvement
        --json: print one JSON object
        """,
    )
    options(parser, FORCE)
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
    check_outputs({'--out': args.out}, args.force, read)
    # What is held out is only looked at, before the long search.
    with muted_warnings():  # they are shown when it is judged
        hashes = [read_material(request, path, 1.0, survey).sha256 for path in args.hold_out]
    share = 0.0 if args.hold_out else HELD_OUT_SHARE
    materials = [read_material(request, path, share, survey) for path in args.recordings]
    hashes += [material.sha256 for material in materials]
    if len(set(hashes)) < len(hashes):
        raise UsageError('a recording is given twice; what is trained on can not be held out, too')
    # What the settings that are tried give reason to warn of is nobody's concern.
    with muted_warnings(), progress_bar('calibrating') as advance:
        if args.only == 'noise':
            found = find_noise(materials, request.settings, lambda: advance(1))
        else:
            kept = request.settings, given.assigned, lambda: advance(1)
            found = CalibrationFinder(materials[0], *kept).find(args.keep_noise)
        stated = state_found(request.settings, request.inputs, found, _sensor_pose(request, found))
        states_motion = any(
            isinstance(event, VelocityEvent) and event.covariance is not None
            for material in materials
            for event in material.events
        )
        noisy = with_noise(stated, found, not states_motion)
        corrected = replace(request, inputs=stated.inputs)
        trained_on = materials
        if corrected != request:
            trained_on = [read_material(corrected, p, share, survey) for p in args.recordings]
        held_out: Iterable[tuple[Material, ...]] = zip(materials, trained_on, strict=True)
        if args.hold_out:
            requests = (request, corrected)
            held_out = (
                tuple(read_material(each, path, 1.0, survey) for each in requests)
                for path in args.hold_out
            )
        rows = [
            (
                as_given.judged(request.settings),
                as_found.judged(stated.settings),
                as_found.judged(noisy.settings),
            )
            for as_given, as_found in held_out
        ]
        if not all(len(judged.likelihood.stamps_ns) for row in rows for judged in row):
            raise UsageError('nothing is seen twice in what is held out')
        before, after, after_noise = map(list, zip(*rows, strict=True))
        # Noise that is found beside other things is left as it was if it is no improvement.
        if args.only == 'noise' or not judge(after, after_noise).objection:
            stated, after = noisy, after_noise
        gain = growth(
            [material.likelihood(request.settings) for material in materials],
            [material.likelihood(stated.settings) for material in trained_on],
        )
    result = _Calibration(request.settings, materials, found, stated, gain, judge(before, after))
    if args.json:
        print_json(_as_json(args, result))
    else:
        _print(args, result)
    if objection := result.verdict.objection:
        raise IncompleteError(f'no improvement: on what was held out {objection}')
    if args.out is not None:
        _write(args, given, result)


@dataclass(frozen=True, slots=True, eq=False)
class _Calibration:
    """What came of a calibration; the ``gain`` of the log likelihood has its deviation."""

    before: Settings
    materials: Sequence[Material]
    found: Found
    stated: Stated
    gain: tuple[float, float]
    verdict: Verdict

    @property
    def trades(self) -> list[Trade]:
        """Pairs of values that can't be distinguished."""
        of_size = [COMMON_SCALE] if self.found.has_no_size else []
        return of_size + trades(self.found.parts, self.found.correlations)


def _sensor_pose(request: Request, found: Found) -> FloatArray | None:
    """Return the pose (4, 4) of the only sensor; None if there are several, or it moves."""
    if len(found.frames) != 1:
        return None
    with Recording(request.recording) as recording:
        selected, inputs, _ = request.select_inputs(recording)
        return recording.sensor_pose(selected, inputs, next(iter(found.frames)))


def _print(args: argparse.Namespace, result: _Calibration) -> None:
    """Print what was found, how well it is known, and how it does on what was held out."""
    found = result.found
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
    unseen = [part.name for part in found.parts if not is_seen(part)]
    if unseen:
        lines['not seen'] = f'{", ".join(unseen)}: left as stated'
    if found.too_noisy:
        lines['too noisy'] = f'velocities for their scale: {", ".join(found.too_noisy)}'
    lines |= {f'trade {i}': trade.text for i, trade in enumerate(result.trades, 1)}
    lines['log likelihood, gain'] = '{:.1f} ± {:.1f}'.format(*result.gain)
    lines |= {f'held out: {name}': text for name, text in _verdict_lines(result.verdict).items()}
    print_table('what it says' if rows else title, lines)


def _as_json(args: argparse.Namespace, result: _Calibration) -> dict[str, object]:
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
        'trades': [asdict(trade) for trade in result.trades],
        'range_is_depth': found.range_is_depth,
        'depth_gain': found.depth_gain,
        'log_likelihood_gain': result.gain,
        'noise_log_factors': {one.kind.name: [one.log, one.deviation] for one in found.noise},
        'motion_factors': {part.name: asdict(part) for part in found.factors},
        'parameters': parameters,
        'held_out': asdict(result.verdict),
    }


def _verdict_lines(verdict: Verdict) -> dict[str, str]:
    """Return what was found on what was held out, before → after."""
    lines = {
        'log likelihood per observation': '{:.3f} → {:.3f}'.format(*verdict.log_likelihood),
        'log likelihood, gain': f'{verdict.gain:.1f} ± {verdict.gain_deviation:.1f}',
    }
    if verdict.error_m is not None:
        lines['configuration error, RMS'] = '{:.3f} → {:.3f} m'.format(*verdict.error_m)
    if verdict.anees is not None:
        lines['ANEES of the configuration'] = '{:.2f} → {:.2f}'.format(*verdict.anees)
    return lines


def _write(args: argparse.Namespace, given: Given, result: _Calibration) -> None:
    """Write the parameter file."""
    held_out = [str(path) for path in args.hold_out] or ['the last third']
    where = 'the map being made' if args.survey is None else f'the map {args.survey.name}'
    head = [
        f'By slam-observer calibrate {__version__} in {where} from',
        *(f'  {one.path.name} (SHA-256 {one.sha256})' for one in result.materials),
        'log likelihood, gain: {:.1f} ± {:.1f}'.format(*result.gain),
        'held out:',
        *(f'  {name}' for name in held_out),
        *(f'  {name}: {text}' for name, text in _verdict_lines(result.verdict).items()),
        'Values ± their standard deviations; what the recording says little of is as it was.',
        'Intervals of noise are of 95 %, by the curvature of the likelihood, as if all',
        'innovations were independent: errors that last make them too narrow.',
    ]
    write_found(args.out, head, given.values, result.stated.groups)


MUCH = 0.9  # correlation beyond which two values trade
WELL_KNOWN = 0.1  # standard deviation over that at the start, below which nobody minds

_WORDS = {
    'range_scale': 'range scale',
    'range_bias': 'bias of ranges',
    'linear_scale': 'wheel scale',
    'angular_scale': 'scale of turning',
    'angular_bias': 'bias of turning',
    'linear_bias': 'bias of driving',
    'velocity_delay': 'delay',
    'sensor_rotation': 'mount angle',
    'sensor_translation': 'mount offset',
}

_ADVICE = (
    (
        {'range_scale', 'linear_scale'},
        'give a surveyed map (--map), or drive a measured distance and state it (--set '
        'linear_scale, linear_scale_stddev)',
    ),
    ({'angular_scale', 'angular_bias'}, 'turn to both sides, fast and slowly'),
    ({'sensor_translation'}, 'turn on the spot, to both sides'),
    ({'velocity_delay'}, 'change speed and direction often'),
)
"""What distinguishes values, by their kinds, the first that fits."""


@dataclass(frozen=True, slots=True)
class Trade:
    """Two values that grow or shrink together without any change in what is seen."""

    names: tuple[str, str]
    correlation: float
    text: str


COMMON_SCALE = Trade(
    ('linear_scale_x', 'range_scale'),
    1.0,
    'range scale and wheel scale trade: the wheels are as the ranges have them; for both of them '
    + _ADVICE[0][1],
)
"""What no map that is made on the way shows: how large it is."""


def trades(parts: Sequence[CalibrationEstimate], correlations: FloatArray) -> list[Trade]:
    """Return the pairs among parts (c,) that can't be distinguished, the closest first."""
    unknown = np.array([p.deviation > WELL_KNOWN * p.stated for p in parts], dtype=np.bool_)
    close = np.triu(np.abs(correlations) > MUCH, 1) & unknown & unknown[:, None]
    found = []
    for i, j in np.argwhere(close).tolist():
        names, correlation = (parts[i].name, parts[j].name), float(correlations[i, j])
        entries = [_entry_of(name) for name in names]
        words = ' and '.join(
            sorted(
                _WORDS[entry.parameter] + ('' if entry.axis is None else f' {"xyz"[entry.axis]}')
                for entry in entries
            )
        )
        kinds = {entry.parameter for entry in entries}
        advice = next(
            (advice for pair, advice in _ADVICE if pair <= kinds),
            'drive with more changes, or state one of them with --set',
        )
        text = f'{words} trade (correlation {correlation:.2f}): {advice}'
        found.append(Trade(names, correlation, text))
    return sorted(found, key=lambda trade: -abs(trade.correlation))


def _entry_of(name: str) -> Entry:
    name = name.partition('/')[0]
    entries = (*OF_VELOCITY, *OF_SENSOR, BIAS_OF_RANGES)
    return next(entry for entry in entries if entry.name == name)


SEEN = 0.5  # standard deviation over that at the start up to which something was seen of a value
OFF = 3.0  # standard deviations from where it was stated beyond which a value is off
CLEARLY_NOISIER = math.log(1.2)  # logarithm of a factor of noise from which it is worth a change

MOUNT = ('sensor_rotation', 'sensor_translation')

Values = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Stated:
    """Settings that state what was found; ``groups`` are the same, each with a comment."""

    settings: Settings
    inputs: InputSettings
    groups: list[tuple[str, Values]]


def is_seen(part: CalibrationEstimate) -> bool:
    """Return whether more is known of a value than at the start."""
    return part.deviation <= SEEN * part.stated


def is_off(part: CalibrationEstimate) -> bool:
    """Return whether a value is surely another than was stated."""
    return is_seen(part) and abs(part.value - part.nominal) > OFF * part.deviation


def state_found(
    settings: Settings, inputs: InputSettings, found: Found, sensor_pose: FloatArray | None
) -> Stated:
    """Return what was found as settings; ``sensor_pose`` (4, 4) is None if it is not constant.

    Where several sensors are calibrated, or one that moves, only what is of the velocities.
    """
    is_one = len(found.frames) == 1
    values: Values = {}
    comments: dict[str, list[str]] = {}
    moved: dict[str, float] = {}
    for part in found.parts:
        name, entry = part.name.partition('/')[0], _entry_of(part.name)
        if entry is BIAS_OF_RANGES:  # no setting has one for each landmark
            continue
        if not is_seen(part) or (name.startswith(('sensor_', 'range_')) and not is_one):
            continue
        # With two digits of the standard deviation, six decimals at most
        digits = 1 - math.floor(math.log10(part.deviation)) if part.deviation > 0.0 else 6
        stated = {
            entry.parameter: round(part.value, min(max(digits, 0), 6)),
            f'{entry.parameter}_stddev': round(part.deviation, min(max(digits, 0), 6)),
        }
        if '_bias' in name:  # which is another one on another day
            del stated[f'{entry.parameter}_stddev']
        if entry.parameter in MOUNT:
            if sensor_pose is None:
                continue
            moved[name] = part.value
            del stated[entry.parameter]
        for parameter, value in stated.items():
            if entry.axis is None:
                values[parameter] = value
            else:
                entries = list(values.get(parameter, getattr(settings, parameter)))
                entries[entry.axis] = value
                values[parameter] = tuple(entries)
        text = f'{part.name}: {part}, looked for within {looked_for(part)}'
        comments.setdefault(entry.parameter, []).append(text)
    groups = [
        ('\n'.join(lines), {name: values[name] for name in (of, f'{of}_stddev') if name in values})
        for of, lines in comments.items()
    ]
    if is_one and found.depth_gain is not None:
        values['range_is_depth'] = found.range_is_depth
        groups.append((depth_text(found), {'range_is_depth': found.range_is_depth}))
    if sensor_pose is not None and moved:
        turn, shift = (
            np.array([moved.get(f'{name}_{axis}', 0.0) for axis in 'xyz']) for name in MOUNT
        )
        angles = Rotation.from_matrix(so3.exp(turn) @ sensor_pose[:3, :3]).as_euler('xyz')
        numbers = [*(sensor_pose[:3, 3] + shift).tolist(), *angles.tolist()]
        x, y, z, roll, pitch, yaw = (round(number, 5) for number in numbers)
        pose: Pose6 = (x, y, z, roll, pitch, yaw)
        inputs = replace(inputs, sensor_pose=pose)
        groups.append(('In place of /tf, which is better put right.', {'sensor_pose': pose}))
    return Stated(replace(settings, **values), inputs, [group for group in groups if group[1]])


def with_noise(stated: Stated, found: Found, states_motion: bool) -> Stated:
    """Return the same with the noise that was found; of motion where messages state none."""
    noise = list(found.noise)
    factors = {part.name: part for part in found.factors} if states_motion else {}
    for kind in kinds_of(stated.settings, of_points=False):
        part = factors.get(kind.name)
        if part is None:
            continue
        log = math.log(part.factor)
        if abs(log) > max(OFF * part.deviation, CLEARLY_NOISIER):
            noise.append(NoiseFactor(kind, log, part.deviation))
    kinds = [one.kind for one in noise]
    settings = scaled(stated.settings, kinds, [one.log for one in noise])
    names = [name for kind in kinds for name in kind.parameters]
    figures: Values = {name: rounded(getattr(settings, name)) for name in names}
    settings = replace(settings, **figures)
    groups = [
        (
            f'Noise of {one.kind.name}: {one} what it was',
            {name: getattr(settings, name) for name in one.kind.parameters},
        )
        for one in noise
    ]
    return replace(stated, settings=settings, groups=[*stated.groups, *groups])


def looked_for(part: CalibrationEstimate) -> str:
    """Return what was known of a value at the start, as text."""
    factor, unit = part.for_people
    return f'{factor * part.nominal:g} ± {factor * part.stated:.2g} {unit}'.rstrip()


def depth_text(found: Found) -> str:
    """Return in words whether ranges are depths, and by what."""
    if found.depth_gain is None:
        return 'range: what is seen is all around, or no whole points'
    what = 'depth along the axis' if found.range_is_depth else 'range'
    gain, deviation = found.depth_gain
    kept = '' if found.range_is_depth == (gain > 0.0) else ', which is not sure, or was not asked'
    return f'{what}: the log likelihood of depth is {gain:+.0f} ± {deviation:.0f} over range{kept}'
