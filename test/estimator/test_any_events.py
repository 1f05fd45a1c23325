"""Whatever comes and whatever is set, nothing raises, and the estimate stays one."""

from __future__ import annotations

from any_events import any_settings, AnyRun, as_list, quietly, ROWS
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
import numpy as np
import pytest
from strategies import generators

from slam_observer_ros.settings.estimator_settings import Settings

pytestmark = pytest.mark.filterwarnings('ignore::RuntimeWarning')

NUMBERS = [row for row in ROWS if not isinstance(row.default, bool | str)]


@hypothesis_settings(max_examples=10)
@given(generators(), st.sampled_from([0.0, 0.1, 0.5]))
def test_whatever_comes_and_is_set_the_estimate_stays_one(rng, share):
    """Blocks, flipped and unset orientations, maps with correlations, live settings, nonsense."""
    settings = any_settings(rng, share)
    quietly(lambda: AnyRun(rng, settings).run(40))


@pytest.mark.parametrize('row', NUMBERS, ids=lambda row: row.name)
def test_at_both_ends_of_each_range_the_estimate_stays_one(row):
    """With the observation model that reads the number, and set from the start or live."""
    models = [name for name in ('stereo', 'fiducial') if name in row.description.lower()]
    model = {'point_noise': 'cartesian'}.get(row.name, (models or ['range_bearing'])[-1])
    for end in (row.minimum, row.maximum):
        is_list = isinstance(row.default, tuple)
        value = as_list(row, [end] * len(row.default)) if is_list else type(row.default)(end)
        often = {'relinearization_interval': 1, 'relinearization_angle': 0.0}
        of_tags = {'observation_model': model, 'use_tag_orientation': model == 'fiducial'}
        settings = Settings(**{**of_tags, **often, row.name: value})
        run = AnyRun(np.random.default_rng(1), settings)
        quietly(lambda run=run: run.run(10))
