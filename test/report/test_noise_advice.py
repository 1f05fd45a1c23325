"""A report names the noise figure that is too small, and no other."""

from __future__ import annotations

import json
import re

import pytest
from recordings import SAMPLE, write_beginning


@pytest.fixture(name='advice')
def fixture_advice(slam_observer, tmp_path):
    def advice(recording=SAMPLE, **settings):
        report = tmp_path / 'run.html'
        options = [
            word for name, value in settings.items() for word in ('--set', f'{name}={value}')
        ]
        ended = slam_observer('replay', recording, '--report', report, *options)
        assert ended.code == 0
        found = re.search(r'id="numbers">(.*?)</script>', report.read_text(), re.S)
        findings = json.loads(found.group(1))['findings']
        return [finding['text'] for finding in findings if 'explain' in finding['text']]

    return advice


def test_noise_that_is_as_stated_is_no_matter(advice):
    assert advice() == []


def test_an_axis_whose_noise_is_understated_is_named(advice):
    texts = advice(angular_velocity_noise='[0.03, 0.03, 0.006]')
    named = [text for text in texts if text.startswith('angular_velocity_noise')]
    assert len(named) == 1
    assert 'of z explain' in named[0]
    assert not [text for text in texts if text.startswith('linear')]


def test_points_whose_noise_is_understated_are_named(advice, tmp_path):
    beginning = write_beginning(tmp_path / 'beginning.mcap', SAMPLE, 40.0)
    texts = advice(beginning, range_noise=0.01, bearing_noise=0.003)
    assert any('noise of the points' in text for text in texts)
    assert not any('noise of the velocity (' in text for text in texts if 'While' not in text)
