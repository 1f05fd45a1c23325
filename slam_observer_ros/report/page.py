"""Pages: of a run, one file with style, script, plotting library and numbers; of a batch."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Container, Mapping, Sequence
from html import escape
from importlib import resources
import json
import math
import os
from pathlib import Path
import re
import sys
from typing import Any, TypeAlias
from urllib.parse import quote

import numpy as np

from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import failing, json_text, OutputError, significant
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import used_points
from slam_observer_ros.messages.outgoing import half_sights
from slam_observer_ros.recordings.trajectory import interpolate
from slam_observer_ros.report.summary import ACCURACY_ROWS, FIGURES
from slam_observer_ros.runs.metrics import (
    average_nees_band,
    CHI_SQUARE_95,
    normalised_squared_errors,
    root_mean_square,
)
from slam_observer_ros.runs.result import Result
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import changed_names, table

Json: TypeAlias = Any  # what json.dumps takes without NaN
MAX_PATH = 4000  # poses that are drawn, of the path and of its errors
MAX_GROUPS, MIN_GROUP = 150, 10  # points of the curve of NIS; each is of so many observations

MAX_RESIDUALS = 6000
MAX_ELLIPSES = 40_000  # landmarks of all instants together that are drawn
FLAT = 0.05  # height of a map over its width, below which only its plan is drawn
UPPER = np.triu_indices(3)  # entries of a covariance that the page has: xx, xy, xz, yy, yz, zz


def write_report(path: Path, result: Result, title: str, rows: Mapping[str, str]) -> None:
    """Write the report of a run; it is whole or not there. Raises an OutputError if it can't.

    ``rows`` are shown as a table, and all that was logged.
    """
    findings = [finding.as_json() | {'text': finding.text()} for finding in result.findings]
    said = {finding['text'] for finding in findings}
    text = {
        'title': title,
        'figures': [[name, value] for name, value in rows.items()],
        'findings': findings,
        'warnings': [warning for warning in map(str, result.logged) if warning not in said],
    }
    # In a script element only `<` could end it.
    numbers = json_text(text | report_data(result), is_compact=True).replace('<', '\\u003c')
    parts = {
        'STYLE': asset('report.css'),
        'PLOTTING_LIBRARY': asset('plotly-basic.min.js'),
        'SCRIPT': asset('report.js'),
        'NUMBERS': numbers,
    }
    write_page(path, 'page.html', parts)


def write_page(path: Path, template: str, parts: Mapping[str, str]) -> None:
    """Write a page with ``@NAME@`` replaced by the part of that name; OutputError if it fails."""
    page = re.sub('@([A-Z_]+)@', lambda mark: parts[mark.group(1)], asset(template))
    with failing(OutputError, f"can't write {path}"), unfinished_file(path) as file:
        file.write(page.encode(errors='replace').decode())  # names may be no Unicode


def asset(name: str) -> str:
    """Return the text of a file that pages are made of."""
    return (resources.files(__package__) / 'assets' / name).read_text(encoding='utf-8')


def rounded(values: FloatArray, digits: int) -> list[Any]:
    """Return nested lists, rounded, with None for what is not finite."""
    numbers = np.round(np.asarray(values, dtype=np.float64), digits)
    listed = numbers.astype(object)
    listed[~np.isfinite(numbers)] = None
    return list(listed.tolist())


def thinned(count: int, most: int) -> slice:
    """Return rows at equal steps, of ``count`` no more than ``most``."""
    return slice(None, None, max(1, -(-count // most)))


def report_data(result: Result) -> dict[str, Json]:
    """Return all that the page shows of a run."""
    settings, smoothed = result.settings, result.smoothed
    defaults = {row.name: row.default for row in table(type(settings))}
    # Smoothed path and map are in the world of the estimate.
    smoothed_data = None
    if smoothed is not None:
        positions = smoothed.trajectory.positions
        smoothed_data = {
            'xyz': rounded(positions[thinned(len(positions), MAX_PATH)].T, 3),
            'points': rounded(smoothed.estimate.world_points.T, 3),
        }
    true_landmarks = None
    if (truth := result.aligned_landmarks) is not None:
        true_landmarks = {'ids': truth.ids.tolist(), 'xyz': rounded(truth.world_points.T, 3)}
    # The plan alone is drawn of what is flat.
    points = [result.run.trajectory.positions, *(i.world_points for i in result.instants[-1:])]
    extents = np.ptp(np.concatenate(points), axis=0) if len(points[0]) else np.zeros(3)
    width, depth, height = extents
    # Messages dropped until each instant
    reasons = sorted({reason for instant in result.instants for reason in instant.dropped})
    return {
        'settings': [
            [name, str(getattr(settings, name)), str(defaults[name])]
            for name in changed_names(settings)
        ],
        'versions': [
            ['slam_observer_ros', __version__],
            ['Python', sys.version.split()[0]],
            ['numpy', np.__version__],
        ],
        'is_flat': bool(height <= FLAT * max(width, depth)),
        'gaps': rounded(result.gaps_s, 2),
        'path': _path(result),
        'instants': _instants(result),
        'smoothed': smoothed_data,
        'landmarks': _landmarks(result),
        'true_landmarks': true_landmarks,
        'errors': _errors(result),
        'consistency': _consistency(result),
        'residuals': _residuals(result),
        'outcomes': _outcomes(result),
        'gate': settings.rejection_threshold,
        'calibration': [_calibration_curve(result, part.name) for part in result.calibration],
        'drops': [
            {'reason': reason, 'count': [each.dropped[reason] for each in result.instants]}
            for reason in reasons
        ],
    }


def _path(result: Result) -> dict[str, Json]:
    trajectory = result.run.trajectory
    some = thinned(len(trajectory), MAX_PATH)
    stamps_ns, positions = trajectory.stamps_ns[some], trajectory.positions[some]
    path = {'t': rounded(result.seconds(stamps_ns), 2), 'xyz': rounded(positions.T, 3)}
    if result.errors is not None:
        true_poses, _ = interpolate(result.errors.aligned_truth, stamps_ns)
        path['true_xyz'] = rounded(true_poses[:, :3, 3].T, 3)
        path['error_m'] = rounded(np.linalg.norm(positions - true_poses[:, :3, 3], axis=1), 3)
    return path


def _instants(result: Result) -> dict[str, Json]:
    """Return robot and map at instants, with the covariances of their positions."""
    total = sum(len(instant.ids) for instant in result.instants)
    some = result.instants[thinned(total, MAX_ELLIPSES)]
    seconds = result.seconds(np.array([instant.stamp_ns for instant in some], dtype=np.int64))
    poses = np.array([instant.pose for instant in some]).reshape(-1, 4, 4)
    halves = [
        (np.empty((0, 3)), np.empty((0, 3)))
        if instant.seen is None
        else half_sights(instant.seen, instant.ids, instant.world_points)
        for instant in some
    ]
    of_poses = [instant.pose_covariance for instant in some]
    return {
        't': rounded(seconds, 2),
        'xyz': rounded(poses[:, :3, 3], 3),
        'ahead': rounded(poses[:, :3, 0], 3),
        'robot': [_covariances(None if P is None else P[None, 3:, 3:]) for P in of_poses],
        'ids': [instant.ids.tolist() for instant in some],
        'in_doubt': [np.isin(i.ids, i.doubted_ids).nonzero()[0].tolist() for i in some],
        'points': [rounded(instant.world_points.T, 3) for instant in some],
        'covariances': [_covariances(instant.landmark_covariances) for instant in some],
        'rings': [rounded(rings, 3) for rings, _ in halves],
        'rays': [rounded(ends, 3) for _, ends in halves],
    }


def _covariances(covariances: FloatArray | None) -> Json:
    """Return the six entries of each covariance, m², with three digits."""
    if covariances is None:
        return None
    return [
        [float(f'{entry:.3g}') for entry in entries]
        for entries in covariances[:, UPPER[0], UPPER[1]].tolist()
    ]


def _landmarks(result: Result) -> list[Json]:
    """Return a row for each landmark of the map: what was seen of it, and how well it fits."""
    if not result.instants:
        return []
    innovations, last = result.innovations, result.instants[-1]
    true_points = {}
    if (truth := result.aligned_landmarks) is not None:
        true_points = dict(zip(truth.ids.tolist(), truth.world_points, strict=True))
    rows: list[Json] = []
    for row, landmark_id in enumerate(last.ids.tolist()):
        of_it = innovations.ids == landmark_id
        used = of_it & (innovations.weights > 0.0)
        error_m = deviation_m = math.nan
        if landmark_id in true_points:
            error_m = float(np.linalg.norm(last.world_points[row] - true_points[landmark_id]))
        if last.landmark_covariances is not None:
            deviation_m = math.sqrt(max(np.trace(last.landmark_covariances[row]), 0.0))
        counted = [
            of_it,
            of_it & ~used,
            used & (innovations.weights < 1.0),
            of_it & innovations.moved,
        ]
        fits = innovations.residuals_m[used], innovations.distances[used]
        fit = [root_mean_square(each) if used.any() else math.nan for each in fits]
        rows.append(
            [
                landmark_id,
                *(int(np.count_nonzero(each)) for each in counted),
                *rounded(np.array([*fit, deviation_m, error_m]), 3),
            ]
        )
    return rows


def _errors(result: Result) -> dict[str, Json]:
    """Return errors of position, m, and heading, °, and half-axes of 95 % ellipses."""
    innovations, configuration = result.innovations, result.run.configuration
    bounds_m = [
        np.nan
        if (P := instant.pose_covariance) is None
        else np.sqrt(CHI_SQUARE_95 * max(np.linalg.eigvalsh(P[3:, 3:])[-1], 0.0))
        for instant in result.instants
    ]
    lyapunov = np.where(innovations.lyapunov > 0.0, innovations.lyapunov, np.nan)
    curves: dict[str, Json] = {
        't': rounded(result.seconds(result.instants_ns), 2),
        'bound_m': rounded(np.array(bounds_m), 3),
        'lyapunov_t': rounded(result.seconds(innovations.update_stamps_ns), 2),
        'lyapunov': rounded(np.log10(lyapunov), 2),
    }

    def draw(name: str, unit: str, stamps_ns: IntArray, values: FloatArray) -> None:
        some = thinned(len(stamps_ns), MAX_PATH)
        curves[f'{name}_t'] = rounded(result.seconds(stamps_ns[some]), 2)
        curves[f'{name}_{unit}'] = rounded(values[some], 3)

    if (errors := result.errors) is not None:
        draw('heading', 'deg', errors.estimate.stamps_ns, np.degrees(errors.errors[:, 2]))
    if result.smoothed is not None and (errors := result.smoothed.pose_errors) is not None:
        stamps_ns = errors.estimate.stamps_ns
        draw('smoothed', 'm', stamps_ns, errors.distances_m)
        draw('smoothed', 'heading_deg', stamps_ns, np.degrees(errors.errors[:, 2]))
    if configuration.values_m:
        values_m = np.array(configuration.values_m)
        draw('configuration', 'm', np.array(configuration.stamps_ns), values_m)
    if (anchored := result.anchored_errors()) is not None:
        of_poses, rows = anchored
        error_m = np.full(len(result.instants), np.nan)
        error_m[rows] = np.linalg.norm(of_poses[:, 3:], axis=1)
        curves['drift_m'] = rounded(error_m, 3)
    return curves


def _consistency(result: Result) -> dict[str, Json]:
    """Return NEES of the pose and NIS, each per degree of freedom, with their 95 % bands."""
    curves: dict[str, Json] = {}
    innovations = result.innovations
    known = np.flatnonzero(innovations.degrees_of_freedom > 0)
    if len(known):
        group = max(MIN_GROUP, -(-len(known) // MAX_GROUPS))
        starts = np.arange(0, len(known), group)
        degrees = np.add.reduceat(innovations.degrees_of_freedom[known], starts)
        nis = np.add.reduceat(innovations.nis[known], starts) / degrees
        middles = np.minimum(starts + group // 2, len(known) - 1)
        bands = np.array([average_nees_band(int(count), 1) for count in degrees])
        curves |= {
            'nis_t': rounded(result.seconds(innovations.update_stamps_ns[known[middles]]), 2),
            'nis': rounded(nis, 3),
            'nis_low': rounded(bands[:, 0], 3),
            'nis_high': rounded(bands[:, 1], 3),
            'nis_group': group,
        }
    of_poses, rows = result.anchored_errors() or (np.empty((0, 6)), np.empty(0, dtype=np.int64))
    covariances = [result.instants[row].pose_covariance for row in rows.tolist()]
    stated = [index for index, covariance in enumerate(covariances) if covariance is not None]
    if not stated:
        return curves
    nees, degrees = normalised_squared_errors(
        of_poses[stated], np.array([covariances[index] for index in stated])
    )
    usable = degrees > 0  # the first pose is exact
    if not usable.any():
        return curves
    return curves | {
        'nees_t': rounded(result.seconds(result.instants_ns)[rows[stated]][usable], 2),
        'nees': rounded(nees[usable] / degrees[usable], 3),
        'nees_band': rounded(np.array(average_nees_band(int(degrees[usable].max()), 1)), 3),
    }


def _residuals(result: Result) -> dict[str, Json]:
    """Return residuals in σ: of a great many the suspicious ones, and some of the others."""
    innovations = result.innovations
    weights, shown = innovations.weights, np.ones(len(innovations.weights), dtype=np.bool_)
    if len(weights) > MAX_RESIDUALS:
        shown = innovations.moved.copy()
        shown[thinned(len(weights), MAX_RESIDUALS // 2)] = True
        suspicious = np.flatnonzero((weights < 1.0) | (innovations.distances > 3.0))
        shown[suspicious[thinned(len(suspicious), MAX_RESIDUALS // 2)]] = True
    return {
        't': rounded(result.seconds(innovations.stamps_ns[shown]), 2),
        'id': innovations.ids[shown].tolist(),
        'sigma': rounded(innovations.distances[shown], 2),
        'm': rounded(innovations.residuals_m[shown], 3),
        'weight': rounded(innovations.weights[shown], 2),
        'moved': np.flatnonzero(innovations.moved[shown]).tolist(),
        'left_out': int(np.count_nonzero(~shown)),
    }


def _outcomes(result: Result) -> dict[str, Json]:
    """Return what became of landmarks, and why points were not used that have no residual."""
    each = result.without_residual
    each = each[thinned(len(each), MAX_RESIDUALS)]
    stamps_ns = np.array([one.stamp_ns for one in each], dtype=np.int64)
    return {
        't': rounded(result.seconds(stamps_ns), 2),
        'id': [one.landmark_id for one in each],
        'what': [one.what.words for one in each],
    }


def _calibration_curve(result: Result, name: str) -> dict[str, Json]:
    """Return what was estimated of a property over time, and its standard deviation."""
    # What is known of a sensor begins where the sensor is heard first.
    known = [
        (instant.stamp_ns, part)
        for instant in result.instants
        for part in instant.calibration
        if part.name == name
    ]
    seconds = result.seconds(np.array([stamp_ns for stamp_ns, _ in known], dtype=np.int64))
    parts = [part for _, part in known]
    factor, unit = parts[-1].for_people
    return {
        'name': name,
        'unit': unit,
        'nominal': factor * parts[-1].nominal,
        't': rounded(seconds, 2),
        'value': rounded(factor * np.array([part.value for part in parts]), 5),
        'deviation': rounded(factor * np.array([part.deviation for part in parts]), 5),
    }


# The page at the end of a batch: tables of many runs, which a click on a heading sorts. They show
# which setting and which run is the best by a score.

INDEX = 'index.html'

Line = dict[str, Any]  # a run that is done, as the log has it
FILES = ('report', 'trajectory')  # what may be written of a run; the line has where, or null
SCORES = tuple(name for name in ACCURACY_ROWS if 'anees' not in name)  # the least is the best

CONSISTENCY = ('anees', 'configuration_anees', 'nis')
"""Figures that are 1 where all is as stated: a mean of them says less than their range."""

_DEFAULTS = {row.name: row.default for row in table(Settings)}


def write_index(directory: Path, lines: Mapping[str, Line], score: str) -> None:
    """Write index.html of all runs of a directory; raise an OutputError if it can't be written."""
    runs = sorted(lines.values(), key=lambda line: (_score(line, score), line['recording']))
    # What runs differ in: settings, the grid's inputs, version.
    named = {name for run in runs for name in (*run['settings'], *run['grid'])} | {'version'}
    names = sorted(name for name in named if len({_text(run, name) for run in runs}) > 1)
    figures = [name for name in FIGURES if any(run.get(name) is not None for run in runs)]
    recordings = {run['recording_sha256'] for run in runs}
    summary = (
        f'{len(runs)} runs of {len(recordings)} recordings. The best (★) has least {score}. '
        'A click on a heading sorts.'
    )
    tables = (table_of(runs, names, figures, score) for table_of in (_settings_table, _runs_table))
    parts = {
        'STYLE': asset('report.css'),
        'SCRIPT': asset('index.js'),
        'TITLE': escape(directory.resolve().name),
        'SUMMARY': escape(summary),
        'TABLES': '\n'.join(tables),
    }
    write_page(directory / INDEX, 'index.html', parts)


def _table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], best: Container[int]
) -> str:
    """Return a table of cells; the ``best`` rows are marked."""
    of_columns = ''.join(
        f'<th scope="col"><button type="button">{_breakable(name)}</button></th>'
        for name in headings
    )
    of_rows = '\n'.join(
        f'<tr{" class=best" if number in best else ""}>{"".join(row)}</tr>'
        for number, row in enumerate(rows)
    )
    return (
        f'<section class="{title.lower()}"><h2>{title}</h2><div class="wide"><table>\n'
        f'<thead><tr>{of_columns}</tr></thead>\n<tbody>\n{of_rows}\n</tbody>'
        '</table></div></section>'
    )


def _cell(value: float | str | None) -> str:
    if value is None:
        return '<td class="number"></td>'
    if isinstance(value, str):
        return f'<td>{_breakable(value)}</td>'
    text = str(value) if isinstance(value, int) else significant(value)
    return f'<td class="number" data-value="{value!r}">{text}</td>'


def _breakable(text: str) -> str:
    """Return a text that a narrow column breaks within its paths and names, but in no word."""
    return re.sub('([/_])', r'\1<wbr>', escape(text))


def _score(run: Line, score: str) -> float:
    value = run.get(score)
    return math.inf if value is None else float(value)


def _text(run: Line, name: str) -> str:
    if name == 'version':
        return str(run['version'])
    default = run['grid'].get(name, _DEFAULTS.get(name))
    value = run['settings'].get(name, default)
    return value if isinstance(value, str) else json.dumps(value)


def _settings_table(
    runs: Sequence[Line], names: Sequence[str], figures: Sequence[str], score: str
) -> str:
    """Return means over recordings, by setting, the best first."""
    groups: defaultdict[tuple[str, ...], list[Line]] = defaultdict(list)
    for run in runs:
        groups[tuple(_text(run, name) for name in names)].append(run)

    def figure_cell(group: Sequence[Line], name: str) -> str:
        values = [float(run[name]) for run in group if run.get(name) is not None]
        if len(values) < len(group):
            return _cell(None)
        if name not in CONSISTENCY:
            return _cell(float(np.mean(values)))
        # Of what should be 1, from the least to the largest, sorted by the worst.
        worst = max(abs(math.log(max(one, 1e-300))) for one in (min(values), max(values)))
        text = f'{significant(min(values))} – {significant(max(values))}'
        return f'<td class="number" data-value="{worst!r}">{text}</td>'

    def mean_score(group: Sequence[Line]) -> float:
        return float(np.mean([_score(run, score) for run in group]))

    # One that has done fewer recordings is not comparable: they may have been the easy ones.
    ordered = sorted(groups.items(), key=lambda item: (-len(item[1]), mean_score(item[1])))
    rows = [
        [*map(_cell, key), _cell(len(group)), *(figure_cell(group, name) for name in figures)]
        for key, group in ordered
    ]
    has_best = bool(ordered) and math.isfinite(mean_score(ordered[0][1]))
    headings = [
        *names,
        'recordings',
        *(f'{name}, {"range" if name in CONSISTENCY else "mean"}' for name in figures),
    ]
    return _table('Settings', headings, rows, {0} if has_best else ())


def _runs_table(
    runs: Sequence[Line], names: Sequence[str], figures: Sequence[str], score: str
) -> str:
    """Return all runs; the best of each recording is marked."""
    rows: list[list[str]] = []
    best: dict[str, int] = {}
    # What all names begin with, down to the folder that they share, is left out.
    folders = [run['recording'].rpartition('/')[0].split('/') for run in runs]
    shared = os.path.commonprefix(folders)  # noqa: RUF071 (names of folders, not characters)
    folder = '/'.join([*shared, '']) if shared else ''
    for number, run in enumerate(runs):
        if math.isfinite(_score(run, score)):
            best.setdefault(run['recording_sha256'], number)
        counts = run.get('used')
        is_known = isinstance(counts, dict) and all(isinstance(n, int) for n in counts.values())
        links = (  # to its files, beside the page
            f'<a href="{escape(quote(run[kind], errors="replace"))}">{kind}</a>'
            for kind in FILES
            if run.get(kind)
        )
        said = ''.join(f'<li>{escape(text)}</li>' for text in run['warnings'])
        if said:  # how many there are, and the texts at a click
            count = len(run['warnings'])
            said = f'<details><summary>{count}</summary><ul>{said}</ul></details>'
        rows.append(
            [
                _cell(run['recording'].removeprefix(folder)),
                f'<td class="links">{" ".join(links)}</td>',
                *(_cell(_text(run, name)) for name in names),
                # 0 is nothing at all, or the velocities alone.
                _cell(used_points(Counter(counts)) if is_known else None),
                *(_cell(run.get(name)) for name in figures),
                f'<td>{said}</td>',
                _cell(run['run']),
            ]
        )
    headings = ['recording', 'files', *names, 'points used', *figures, 'warnings', 'run']
    return _table('Runs', headings, rows, set(best.values()))
