"""What was replayed, and by what, so that figures can be found again."""

from __future__ import annotations

import hashlib
from pathlib import Path

from slam_observer_ros.cli.replay.outcome import ReplayOutcome
from slam_observer_ros.common.input_files import not_special
from slam_observer_ros.common.version import VERSION
from slam_observer_ros.recording.opening import files_of
from slam_observer_ros.settings.parameter_table import changed_names

_BLOCK_BYTES = 1 << 20


def identity(recording: Path, sha256: str, outcome: ReplayOutcome) -> dict[str, object]:
    """Return what was replayed, by what, as ``--json`` has it first."""
    settings = outcome.result.estimator.settings
    return {
        'recording': str(recording),
        'recording_sha256': sha256,
        'version': VERSION,
        'settings': {name: getattr(settings, name) for name in changed_names(settings)},
        'warnings': list(outcome.warnings),
    }


def sha256_of(recording: Path) -> str:
    """Return the SHA-256 of a recording's files, one after the other, as hexadecimal digits."""
    digest = hashlib.sha256()
    for file in files_of(recording):
        with not_special(file).open('rb') as opened:
            while block := opened.read(_BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()
