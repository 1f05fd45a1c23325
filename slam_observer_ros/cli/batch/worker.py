"""One run of a batch, in whatever process or on whatever machine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from slam_observer_ros.cli.batch.jobs import Job
from slam_observer_ros.cli.console import kept_warnings
from slam_observer_ros.cli.replay.files import write_report_of
from slam_observer_ros.cli.replay.request import Records
from slam_observer_ros.cli.replay.run import replayed
from slam_observer_ros.cli.replay.summary import as_json, identity, summary_rows
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.version import VERSION
from slam_observer_ros.evaluation.trajectory import write_tum

REPORTS, TRAJECTORIES = 'reports', 'trajectories'
"""Folders of ``--out`` for files of the runs."""


@dataclass(frozen=True, slots=True)
class Work:
    """Does the jobs of a batch, and writes those files of each that are asked for."""

    out: Path
    writes_reports: bool
    writes_trajectories: bool
    version: str = VERSION

    def __call__(self, job: Job) -> dict[str, object]:
        """Do a run, write its files, and return its line of the log."""
        if self.version != VERSION:
            raise UsageError(f'this worker has version {VERSION}, the batch {self.version}')
        report = self._file(REPORTS, job, '.html') if self.writes_reports else None
        tum = self._file(TRAJECTORIES, job, '.tum') if self.writes_trajectories else None
        records = Records(poses=tum is not None, whole_run=report is not None)
        with kept_warnings() as warnings:
            outcome, _ = replayed(replace(job.request, records=records), shows_progress=False)
        outcome = replace(outcome, warnings=warnings)
        if tum is not None:
            write_tum(outcome.trajectory, tum)
        if report is not None:
            write_report_of(job.file_stem, outcome, summary_rows(outcome), report)
        return {
            'run': job.run_id,
            'grid': job.point,
            'report': self._relative(report),
            'trajectory': self._relative(tum),
            **identity(job.recording, job.recording_sha256, outcome),
            **as_json(outcome),
        }

    def _file(self, folder: str, job: Job, suffix: str) -> Path:
        return self.out / folder / f'{job.file_stem}{suffix}'

    def _relative(self, file: Path | None) -> str | None:
        return None if file is None else file.relative_to(self.out).as_posix()
