"""``slam-observer tune``: the noise that makes the innovations of a recording most likely."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from slam_observer_ros.cli.console import muted_warnings, print_json, print_table, shown_steps
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
from slam_observer_ros.cli.noise_tuning import (
    certainty,
    Found,
    kinds_of,
    NoiseKind,
    rounded,
    scaled,
    search_noise,
)
from slam_observer_ros.cli.options import named_path, read_given
from slam_observer_ros.cli.outputs import (
    check_inputs_are_kept,
    check_outputs,
)
from slam_observer_ros.cli.replay_request import read_request
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.recording.opening import files_of
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import write_found


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Find the noise figures, and nothing else, that make what was seen most likely; no truth '
        'is needed. What is found must hold on what was held out: other recordings, or the last '
        'third of each. If it does not, no file is written, and the exit code is 4.'
    )
    parser.add_argument('recordings', nargs='+', type=named_path, metavar='RECORDING')
    add_material_options(parser, 'train on all of the others', '--out')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Tune on some recordings, and judge on what was held out."""
    given = read_given(args)
    request = read_request(args, given, args.recordings[0])
    settings = request.settings
    request.need_errors('tune')
    recordings = [*args.recordings, *args.hold_out]
    read = {f'the recording {path}': files_of(path) for path in recordings}
    check_inputs_are_kept({'--out': args.out}, read)
    check_outputs([args.out], args.force)
    with muted_warnings():  # they are shown when it is judged; here, before the long search
        hashes = [
            read_material(replace(request, recording=path), 1.0).sha256 for path in args.hold_out
        ]
    share = 0.0 if args.hold_out else HELD_OUT_SHARE
    trained_on = [
        read_material(replace(request, recording=path), share) for path in args.recordings
    ]
    hashes += [material.sha256 for material in trained_on]
    if len(set(hashes)) < len(hashes):
        raise UsageError('a recording is given twice; what is trained on can not be held out, too')
    # What the settings that are tried give reason to warn of is nobody's concern.
    with muted_warnings(), shown_steps('tuning') as advance:
        likelihoods = [material.likelihood for material in trained_on]
        kinds, found = search_noise(likelihoods, settings, kinds_of(settings), advance)
    if not kinds:
        raise UsageError('no noise figure has an effect: messages state all covariances')
    tuned = _rounded(scaled(settings, kinds, found.log_factors.tolist()), kinds)
    held_out = read_held_out([request], args.hold_out) if args.hold_out else zip(trained_on)
    before, after = judged_by([settings, tuned], ([one, one] for (one,) in held_out))
    verdict = judge(before, after)
    _print(args, settings, tuned, kinds, found, verdict)
    check_improvement(verdict)
    if args.out is not None:
        head = _head(trained_on, args.hold_out, verdict)
        write_found(args.out, head, given.values, _groups(tuned, kinds, found))


def _rounded(settings: Settings, kinds: Sequence[NoiseKind]) -> Settings:
    """Return settings as they are written to a file."""
    values = {name: rounded(getattr(settings, name)) for kind in kinds for name in kind.parameters}
    return Settings(**asdict(settings) | values)


def _head(trained_on: Sequence[Material], held_out: Sequence[Path], verdict: Verdict) -> list[str]:
    """Return what the parameter file says first."""
    return [
        f'Noise by slam-observer tune {__version__}: maximum likelihood of the innovations of',
        *(f'  {one.path.name} (SHA-256 {one.sha256})' for one in trained_on),
        *judged_lines([str(path) for path in held_out] or ['the last third of each'], verdict),
        'Intervals are of 95 %, by the curvature of the likelihood, as if all innovations were',
        'independent: errors that last make them too narrow.',
    ]


def _groups(
    tuned: Settings, kinds: Sequence[NoiseKind], found: Found
) -> list[tuple[str, dict[str, object]]]:
    """Return the parameters that were tuned, by kind, each with a comment."""
    return [
        (
            f'{kind.name}: {text} what it was',
            {name: getattr(tuned, name) for name in kind.parameters},
        )
        for kind, text in zip(kinds, _certainties(found), strict=True)
    ]


def _certainties(found: Found) -> list[str]:
    pairs = zip(found.log_factors.tolist(), found.deviations.tolist(), strict=True)
    return [certainty(*pair) for pair in pairs]


def _print(
    args: argparse.Namespace,
    before: Settings,
    tuned: Settings,
    kinds: Sequence[NoiseKind],
    found: Found,
    verdict: Verdict,
) -> None:
    """Print what was found, and how it does on what was held out."""
    names = [name for kind in kinds for name in kind.parameters]
    if args.json:
        deviations = found.deviations.tolist()
        figures = {
            'before': {name: getattr(before, name) for name in names},
            'tuned': {name: getattr(tuned, name) for name in names},
            'log_factors': dict(
                zip([kind.name for kind in kinds], found.log_factors.tolist(), strict=True)
            ),
            'log_factor_deviations': {
                kind.name: deviation for kind, deviation in zip(kinds, deviations, strict=True)
            },
            'held_out': asdict(verdict),
        }
        print_json(figures)
        return
    rows = {}
    for kind, text in zip(kinds, _certainties(found), strict=True):
        for name in kind.parameters:
            rows[name] = f'{getattr(before, name)} → {getattr(tuned, name)}'
        rows[kind.name] = text
    held_out = {f'held out: {name}': text for name, text in verdict_lines(verdict).items()}
    print_table('noise', rows | held_out)
