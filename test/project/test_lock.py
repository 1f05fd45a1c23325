"""What is installed beside the package is what it was when it was tried, to the byte."""

from __future__ import annotations

from pathlib import Path
import re

import pytest

CHECKOUT = Path(__file__).parents[2]
LOCKS = ('requirements.lock', 'requirements-develop.lock')


def pins(text: str) -> dict[str, set[str]]:
    """Return the versions by name of what is pinned, but on Windows alone."""
    found: dict[str, set[str]] = {}
    for name, version, marker in re.findall(r'^([a-z0-9-]+)==([^\s;]+)(.*)$', text, re.MULTILINE):
        if 'win32' not in marker:
            found.setdefault(name, set()).add(version)
    return found


@pytest.mark.parametrize('name', LOCKS)
def test_the_locked_versions_are_those_of_the_constraints(name):
    locked = pins((CHECKOUT / name).read_text())
    constraints = pins((CHECKOUT / 'constraints.txt').read_text())
    assert locked == {name: constraints.get(name) for name in locked}


@pytest.mark.parametrize('name', LOCKS)
def test_each_has_a_hash(name):
    for entry in re.split(r'\n(?=[a-z])', (CHECKOUT / name).read_text())[1:]:
        assert '--hash=sha256:' in entry, entry
