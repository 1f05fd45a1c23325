"""One HTML file with style, script, plotting library and numbers inside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

from slam_observer_ros.common.digits import json_text
from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.output_files import unfinished_file
from slam_observer_ros.report.data import report_data
from slam_observer_ros.runs.reported_run import ReportedRun

_PARTS = {
    'STYLE': 'report.css',
    'PLOTTING_LIBRARY': 'plotly-basic.min.js',
    'SCRIPT': 'report.js',
}


def write_report(
    path: Path,
    run: ReportedRun,
    title: str,
    figures: Mapping[str, str],
    findings: Sequence[Finding],
    warnings: Sequence[str],
) -> None:
    """Write the report of a run; it is whole or not there. Raises an OutputError if it can't.

    ``figures`` are shown as a table; ``warnings`` are those that no finding says.
    """
    text = {
        'title': title,
        'figures': [[name, value] for name, value in figures.items()],
        'findings': [finding.as_json() | {'text': finding.text()} for finding in findings],
        'warnings': list(warnings),
    }
    page = asset('page.html')
    for mark, name in _PARTS.items():
        page = page.replace(f'@{mark}@', asset(name), 1)
    # In a script element only `<` could end it.
    numbers = json_text(text | report_data(run), is_compact=True)
    page = page.replace('@NUMBERS@', numbers.replace('<', '\\u003c'), 1)
    try:
        with unfinished_file(path) as file:
            file.write(page)
    except OSError as error:
        raise OutputError(f"can't write {path}: {error.strerror}") from error


def asset(name: str) -> str:
    """Return the text of a file that pages are made of."""
    return (resources.files(__package__) / 'assets' / name).read_text(encoding='utf-8')
