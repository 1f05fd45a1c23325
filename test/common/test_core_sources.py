"""What was compiled is used with the sources that it was built from, and with no others."""

from __future__ import annotations

import shutil

import pytest

from slam_observer_ros.common import process as compiled

NAMES = ('filter._core', 'smoothing._gauss_newton')


@pytest.fixture(name='sources')
def fixture_sources(tmp_path, monkeypatch):
    """Return a folder that takes the package's place, with the sources of what is compiled."""
    if compiled.compiled(NAMES[0]) is None:
        pytest.skip('the core was not compiled, or is not to be used')
    for folder in ('filter', 'smoothing'):
        (tmp_path / folder).mkdir()
        for path in (compiled.PACKAGE / folder).glob('_*.[ch]'):
            shutil.copy(path, tmp_path / folder)
    monkeypatch.setattr(compiled, 'PACKAGE', tmp_path)
    return tmp_path


@pytest.mark.parametrize('name', NAMES)
def test_a_core_built_from_other_sources_is_not_used_and_how_to_build_it_is_said(name, sources):
    assert compiled.compiled(name) is not None
    with (sources / 'filter' / '_door.h').open('a') as header:
        header.write('\n')
    with pytest.warns(RuntimeWarning, match=r'from other sources .* build it by `make`'):
        assert compiled.compiled(name) is None


@pytest.mark.parametrize('name', NAMES)
def test_a_core_that_was_installed_without_its_sources_is_used(name, sources):
    for path in sources.glob('*/_*'):
        path.unlink()
    assert compiled.compiled(name) is not None
