#!/usr/bin/env python3
"""Make the pictures of reports in docs/images: replay, open in headless Chromium, photograph.

The sample comes with the repository; other recordings are made from the public data sets in the
folder that SLAM_OBSERVER_DATA names, and left as they are without it.
"""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile

from slam_observer_ros.cli.main import main as slam_observer

CHECKOUT = Path(__file__).resolve().parent.parent
IMAGES = CHECKOUT / 'docs' / 'images'
SIZE = (1000, 1130)


def photograph(report: Path, seconds: float, image: Path) -> None:
    """Open a report at a time of its run, and keep what a window of SIZE shows."""
    browser = shutil.which('chromium') or shutil.which('chromium-browser')
    if browser is None:
        sys.exit('no Chromium is installed: apt-get install chromium')
    command = [browser, '--headless=new', '--no-sandbox', '--disable-gpu', '--hide-scrollbars']
    command += ['--virtual-time-budget=10000', f'--window-size={SIZE[0]},{SIZE[1]}']
    command += [f'--screenshot={image}', f'{report.as_uri()}#t={seconds:g}']
    subprocess.run(command, check=True, capture_output=True, timeout=100)


def replay(recording: Path, seconds: float, name: str, *options: str) -> None:
    """Replay a recording, and photograph its report."""
    with tempfile.TemporaryDirectory() as directory:
        report = Path(directory) / f'{name}.html'
        if slam_observer(['replay', str(recording), '--report', str(report), *options]):
            sys.exit(f'{recording} could not be replayed')
        photograph(report, seconds, IMAGES / f'report_{name}.png')


def convert(directory: str, name: str, *data_set: str) -> Path:
    """Make a recording of a data set."""
    recording = Path(directory) / f'{name}.mcap'
    if slam_observer(['convert', *data_set, str(recording)]):
        sys.exit(f'{name} could not be converted')
    return recording


def main() -> None:
    """Make all pictures that the data at hand allows."""
    sample = CHECKOUT / 'samples' / 'sample.mcap'
    replay(sample, 60.0, 'sample')
    replay(sample, 60.0, 'backwards', '--set', 'sensor_pose=[0, 0, 0, 0, 0, 3.1416]')
    data = Path(os.environ.get('SLAM_OBSERVER_DATA', CHECKOUT / '..' / 'shared' / 'data'))
    with tempfile.TemporaryDirectory() as directory:
        circle = Path(directory) / 'circle.mcap'
        if slam_observer(['simulate', '--bias', '1.5', '--output', str(circle)]):
            sys.exit('the circle could not be simulated')
        replay(circle, 1.0, 'circle', '--gains', 'constant')
        if (folder := data / 'mrclam' / 'MRCLAM_Dataset6').is_dir():
            recording = convert(directory, 'mrclam6_4', 'mrclam', str(folder), '--robot', '4')
            replay(recording, 320.0, 'mrclam6_4', '--config', 'mrclam')
        if (file := data / 'starry_night' / 'dataset3.mat').is_file():
            recording = convert(directory, 'starry_night', 'starry-night', str(file))
            replay(recording, 162.0, 'starry_night', '--config', 'stereo_inertial')


if __name__ == '__main__':
    main()
