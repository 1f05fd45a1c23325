"""One run of a batch, in whatever process or on whatever machine."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

from slam_observer_ros.cli.batch.jobs import Job
from slam_observer_ros.cli.console import kept_warnings
from slam_observer_ros.cli.replay.asked import without_outputs
from slam_observer_ros.cli.replay.identity import identity
from slam_observer_ros.cli.replay.run import replayed
from slam_observer_ros.cli.replay.summary import as_json, summary_rows
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.version import VERSION
from slam_observer_ros.evaluation.trajectory import write_tum

REPORTS, TRAJECTORIES = 'reports', 'trajectories'
"""Folders of ``--out`` for files of the runs."""


@dataclass(frozen=True, slots=True)
class Work:
    """Does the jobs of a batch; ``args`` are its options."""

    args: argparse.Namespace
    out: Path
    version: str = VERSION

    def __call__(self, job: Job) -> dict[str, object]:
        """Do a run, write its files, and return its line of the log."""
        if self.version != VERSION:
            raise UsageError(f'this worker has version {VERSION}, the batch {self.version}')
        args = without_outputs(self.args, job.recording)
        args.report = self._file(REPORTS, job, '.html') if self.args.reports else None
        args.tum = self._file(TRAJECTORIES, job, '.tum') if self.args.trajectories else None
        with kept_warnings() as warnings:
            outcome, _ = replayed(args, job.asked, shows_progress=False)
        outcome = replace(outcome, warnings=warnings)
        if args.tum is not None:
            write_tum(outcome.trajectory, args.tum)
        if args.report is not None:
            from slam_observer_ros.cli.replay.drawn import write_report_of  # takes a while to load

            write_report_of(job.file_stem, outcome, summary_rows(outcome), args.report)
        return {
            'run': job.run_id,
            'grid': job.point,
            'report': self._relative(args.report),
            'trajectory': self._relative(args.tum),
            **identity(job.recording, job.recording_sha256, outcome),
            **as_json(outcome),
        }

    def _file(self, folder: str, job: Job, suffix: str) -> Path:
        return self.out / folder / f'{job.file_stem}{suffix}'

    def _relative(self, file: Path | None) -> str | None:
        return None if file is None else file.relative_to(self.out).as_posix()
