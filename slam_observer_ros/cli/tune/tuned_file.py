"""The parameter file of a tuning, whose comments say how each value came about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path

from slam_observer_ros import __version__
from slam_observer_ros.cli.tune.noise_kinds import NoiseKind
from slam_observer_ros.cli.tune.verdict import Verdict
from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import value_text
from slam_observer_ros.settings.parameter_table import Value

DIGITS = 3
"""Significant digits of a noise figure; it is seldom known to so many."""


def rounded(value: Value) -> Value:
    """Return a figure, or a vector of them, as it is written."""
    if isinstance(value, tuple):
        return tuple(_rounded(entry) for entry in value)
    return _rounded(float(value))


def _rounded(value: float) -> float:
    return float(f'{value:.{DIGITS}g}')


def certainty(log_factor: float, deviation: float) -> str:
    """Return a factor and its interval of 95 % as text."""
    factor = math.exp(log_factor)
    if not math.isfinite(deviation):
        return f'× {factor:.2g}, of which the recording says little'
    low, high = (math.exp(log_factor + sign * 2.0 * deviation) for sign in (-1, 1))
    return f'× {factor:.2g} ({low:.2g} to {high:.2g})'


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


def write_tuned(
    path: Path,
    given: Mapping[str, object],
    settings: Settings,
    tuned: Sequence[tuple[NoiseKind, str]],
    trained_on: Sequence[str],
    held_out: Sequence[str],
    verdict: Verdict,
) -> None:
    """Write what was given, and what was tuned in its place; an OutputError if that fails."""
    head = [
        f'Noise by slam-observer tune {__version__}: maximum likelihood of the innovations of',
        *(f'  {name}' for name in trained_on),
        *judged_lines(held_out, verdict),
        'Intervals are of 95 %, by the curvature of the likelihood, as if all innovations were',
        'independent: errors that last make them too narrow.',
    ]
    found = [
        (
            f'{kind.name}: {text} what it was',
            {name: rounded(getattr(settings, name)) for name in kind.parameters},
        )
        for kind, text in tuned
    ]
    write_found(path, head, given, found)


def judged_lines(held_out: Sequence[str], verdict: Verdict) -> list[str]:
    """Return what the head of a file says of what was held out."""
    return [
        'held out:',
        *(f'  {name}' for name in held_out),
        *(f'  {name}: {text}' for name, text in verdict_lines(verdict).items()),
    ]


def write_found(
    path: Path,
    head: Sequence[str],
    given: Mapping[str, object],
    found: Sequence[tuple[str, Mapping[str, object]]],
) -> None:
    """Write parameters as given but for those found, which have a comment for each group."""
    names = {name for _, values in found for name in values}
    lines = [*(f'# {line}' for line in head), '/**:', '  ros__parameters:']
    others = {name: value for name, value in given.items() if name not in names}
    if others:
        lines += ['    # As it was given', *(_entry(name, others[name]) for name in others)]
    for comment, values in found:
        lines += ['', *(f'    # {line}' for line in comment.splitlines())]
        lines += [_entry(name, value) for name, value in values.items()]
    try:
        with unfinished_file(path) as file:
            file.write('\n'.join(lines) + '\n')
    except OSError as error:
        raise OutputError(f"can't write {path}: {error.strerror}") from error


def _entry(name: str, value: object) -> str:
    return f'    {name}: {value_text(value)}'
