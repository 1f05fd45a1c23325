"""Whatever may be wrong is said in words that are clear, with what to do about it."""

from __future__ import annotations

from collections import Counter
import json
from pathlib import Path
import re
import string

import pytest
from recordings import events

import slam_observer_ros
from slam_observer_ros.common.findings import found, KINDS, Level
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.runs.health import of_fit, of_left_out, of_rejections
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.settings.parameter_table import table

IMPERATIVES = re.compile(
    r'(add|check|do|drive|give|is|keep|let|load|look|mind|move|only|record|remap|resume|see|send|set|'
    r'state|survey|synchronise|take|to keep|try|use|has|are|did|if|some|max_landmarks|where)\b'
)
"""How a remedy begins: it says what to do, or asks what to look at."""


VALUES = {'true': True, 'false': False}


class Figure:
    """Any figure, whatever format is asked for."""

    def __format__(self, _spec):
        return '7'


def figures_of(kind):
    texts = (KINDS[kind].what, KINDS[kind].remedy)
    names = {name for text in texts for _, name, _, _ in string.Formatter().parse(text) if name}
    return dict.fromkeys(names, Figure())


def test_a_finding_says_what_is_wrong_and_what_to_do():
    for kind in KINDS:
        finding = found(kind, **figures_of(kind))
        assert (finding.kind, finding.level) == (kind, KINDS[kind].level)
        for text in (finding.what, finding.remedy):
            assert text == ' '.join(text.split()) != ''
            assert not text.endswith(('.', ':', ';', ','))
            assert '{' not in text
            assert '?' not in text[:-1]
        remedy = KINDS[kind].remedy
        assert remedy.startswith('{') or IMPERATIVES.match(finding.remedy), finding.remedy
        assert finding.text().startswith((finding.what[0].upper(), finding.what[0]))
        assert finding.text()[-1] in '.?'
        assert json.loads(json.dumps(finding.as_json()))['level'] in ('note', 'warning', 'error')


def test_a_note_stands_behind_what_is_wrong():
    finding = found('late_velocity')
    assert 'only from then on (10 so far): set reorder_window' in finding.text(' (10 so far)')


@pytest.mark.parametrize(
    ('factor', 'found_so'),
    [
        (None, []),
        (1e-3, []),  # sensors without noise, as a simulation's may be
        (0.3, [('large_noise', Level.NOTE)]),
        (1.0, []),
        (1.5, [('small_noise', Level.NOTE)]),
        (2.5, [('small_noise', Level.WARNING)]),
    ],
)
def test_noise_is_judged_by_the_size_of_innovations(factor, found_so):
    assert [(finding.kind, finding.level) for finding in of_fit(factor)] == found_so


def test_few_rejections_and_no_points_left_out_are_no_finding():
    counts = Counter(observed_point=100, rejected_landmark=10, rejected_orientation=50)
    assert of_rejections(counts) == of_left_out(counts, Level.NOTE) == []
    kinds = [
        finding.kind for finding in of_rejections(counts + counts - Counter(observed_point=1))
    ]
    assert kinds == ['rejected_points', 'rejected_orientations']


@pytest.fixture(name='wild')
def fixture_wild(tmp_path):
    """A drive whose landmarks jump about: most of what is seen is rejected."""
    with RecordingWriter(tmp_path / 'wild.mcap') as writer:
        for number, event in enumerate(events()):
            if isinstance(event, ObservationEvent) and number % 4 > 1 and number > 20:
                event.points[:] += 3.0
            writer.write_event(event)
    return tmp_path / 'wild.mcap'


def test_log_json_report_and_recorded_diagnostics_say_the_same(wild, tmp_path, slam_observer):
    report = tmp_path / 'run.html'
    ended = slam_observer('replay', wild, '--json', '--report', report, '--gains', 'riccati')
    findings = ended.json['findings']
    assert 'rejected_points' in [finding['kind'] for finding in findings]
    numbers = json.loads(re.search(r'id="numbers">(.*?)</script>', report.read_text(), re.S)[1])
    shown = [{k: v for k, v in finding.items() if k != 'text'} for finding in numbers['findings']]
    assert shown == findings
    texts = [finding['text'] for finding in numbers['findings'] if finding['level'] != 'note']
    assert texts
    for text in texts:
        assert text in ended.json['warnings']
        assert f'warning: {text}' in ended.errors
        assert text not in numbers['warnings']


@pytest.mark.parametrize(
    'folder',
    ['recordings', 'messages', 'estimator', 'tracking', 'mapping', 'smoothing'],
)
def test_what_is_logged_below_the_command_line_is_a_finding(folder):
    for path in (Path(slam_observer_ros.__file__).parent / folder).glob('*.py'):
        said = re.findall(r'logger\.(?:warning|error)\((.*)', path.read_text(encoding='utf-8'))
        is_finding = re.compile(r"'%s', (found\(|finding\)|self\.problem\()")
        assert all(is_finding.match(words) for words in said), path


def test_what_a_remedy_says_to_set_can_be_set():
    """Names of parameters are the tables', and values fit them."""
    rows = {row.name: row for owner in (Settings, ObserverNodeSettings) for row in table(owner)}
    for kind in KINDS.values():
        for name, value in re.findall(r'\b([a-z]+(?:_[a-z]+)+): (\w[\w.]*)', kind.remedy):
            assert name in rows, kind
            rows[name].check(VALUES.get(value, value) if value[0].isalpha() else float(value))
