"""The style checks that a ROS workspace runs on its packages."""

from __future__ import annotations

from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PATHS = [
    str(CHECKOUT / name)
    for name in ('slam_observer_ros', 'demo', 'launch', 'scripts', 'test', 'benchmark', 'setup.py')
    if (CHECKOUT / name).exists()
]


@pytest.mark.linter
def test_ament_flake8_is_content():
    main = pytest.importorskip('ament_flake8.main')
    code, errors = main.main_with_errors(argv=['--config', str(CHECKOUT / 'setup.cfg'), *PATHS])
    assert code == 0, '\n'.join(errors)


@pytest.mark.linter
def test_ament_pep257_is_content():
    main = pytest.importorskip('ament_pep257.main')
    # Summaries stand on the first line (not D213), properties are named by nouns (not D401),
    # and a parameter whose name says it all is not described (not D417).
    assert main.main(argv=['--add-ignore', 'D213', 'D401', 'D417', '--', *PATHS]) == 0
