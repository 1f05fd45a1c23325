"""The report of a replay: one file, whole, small, with what happened in it."""

from __future__ import annotations

from dataclasses import replace
import hashlib
import json
from pathlib import Path
import re
import shutil
from unittest.mock import Mock

from browser import open_page, Opened
from nameless_points import creep, observe, stand
import numpy as np
import pytest
from recordings import events, MESSAGE_COUNT, SAMPLE, write_events, write_mcap

from slam_observer_ros import __version__
from slam_observer_ros.cli.main import main
from slam_observer_ros.events import BEARING, Event, ObservationEvent, RANGE
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.runs.run_health import growth_windows

MEGABYTE = 1_000_000
FIGURES = 'curves', 'map', 'side'


@pytest.fixture(name='reported', scope='module')
def fixture_reported(tmp_path_factory):
    """A folder with a recording and its report."""
    folder = tmp_path_factory.mktemp('reported')
    recording = write_mcap(folder / 'run.mcap')
    assert main(['replay', str(recording), '--report', str(folder / 'run.html')]) == 0
    return folder


@pytest.fixture(name='report')
def fixture_report(reported, tmp_path):
    shutil.copytree(reported, tmp_path, dirs_exist_ok=True)
    return tmp_path / 'run.html'


@pytest.fixture(name='report_of_the_sample', scope='module')
def fixture_report_of_the_sample(tmp_path_factory):
    report = tmp_path_factory.mktemp('sample') / 'run.html'
    assert main(['replay', str(SAMPLE), '--report', str(report)]) == 0
    return report


@pytest.fixture(name='opened', scope='module')
def fixture_opened(reported):
    return open_page(reported / 'run.html')


def numbers_of(report: Path):
    found = re.search(
        r'<script type="application/json" id="numbers">(.*?)</script>', report.read_text(), re.S
    )
    return json.loads(found.group(1), parse_constant=lambda name: pytest.fail(name))


def test_a_report_has_path_truth_map_and_residuals_in_one_file(report):
    numbers = numbers_of(report)
    assert numbers['title'] == 'run.mcap'
    assert len(numbers['path']['t']) == len(numbers['path']['error_m'])
    assert max(numbers['path']['error_m']) < 0.01
    assert [row[0] for row in numbers['landmarks']] == [3, 5, 9]
    # 50 observations of three landmarks; of the first there is nothing to compare with.
    assert len(numbers['residuals']['sigma']) == 3 * 49
    assert numbers['instants']['ids'][-1] == [3, 5, 9]
    assert report.stat().st_size < 2 * MEGABYTE


def test_what_gains_do_not_know_is_left_out(slam_observer, tmp_path):
    recording, report = write_mcap(tmp_path / 'run.mcap'), tmp_path / 'run.html'
    slam_observer.succeed('replay', recording, '--gains', 'constant', '--report', report)
    assert 'nis' not in numbers_of(report)['consistency']


def test_what_is_estimated_of_a_sensor_begins_where_it_is_heard(slam_observer, tmp_path):
    recording, report = tmp_path / 'run.mcap', tmp_path / 'run.html'
    with RecordingWriter(recording) as writer:
        for number, event in enumerate(events()):
            if number > MESSAGE_COUNT or not isinstance(event, ObservationEvent):
                writer.write_event(event)
    settings = ('linear_bias_stddev=[0.01,0,0]', 'sensor_rotation_stddev=[0,0,0.1]')
    options = [word for setting in settings for word in ('--set', setting)]
    slam_observer.succeed('replay', recording, *options, '--report', report)
    numbers = numbers_of(report)
    begins = {}
    for part in numbers['calibration']:
        assert len(part['t']) == len(part['value']) == len(part['deviation'])
        assert part['t'][-1] == numbers['errors']['t'][-1]
        begins[part['name'].partition('/')[0]] = part['t'][0]
    assert begins['linear_bias_x'] == numbers['errors']['t'][0]
    assert begins['sensor_rotation_z'] > begins['linear_bias_x']


def test_settings_that_differ_are_listed(slam_observer, tmp_path):
    recording, report = write_mcap(tmp_path / 'run.mcap'), tmp_path / 'run.html'
    slam_observer.succeed('replay', recording, '--set', 'point_noise=0.03', '--report', report)
    assert ['point_noise', '0.03'] in [row[:2] for row in numbers_of(report)['settings']]


def test_json_says_what_was_replayed_and_how(slam_observer, tmp_path):
    recording = write_mcap(tmp_path / 'run.mcap')
    ended = slam_observer.succeed('replay', recording, '--set', 'range_noise=0.2', '--json')
    figures = ended.json
    assert figures['recording'] == str(recording)
    assert figures['recording_sha256'] == hashlib.sha256(recording.read_bytes()).hexdigest()
    assert figures['settings'] == {'range_noise': 0.2}
    assert (figures['version'], figures['warnings']) == (__version__, [])
    assert figures['nis'] >= 0.0


def test_nis_is_the_same_with_a_report(slam_observer, tmp_path):
    recording = write_mcap(tmp_path / 'run.mcap')
    plain = slam_observer.succeed('replay', recording, '--json').json
    report = ('--report', tmp_path / 'run.html')
    assert slam_observer.succeed('replay', recording, '--json', *report).json[
        'nis'
    ] == pytest.approx(plain['nis'])


def test_the_sample_is_small_and_replays_with_default_settings(slam_observer):
    assert SAMPLE.stat().st_size < 2 * MEGABYTE
    figures = slam_observer.succeed('replay', SAMPLE, '--json').json
    assert figures['landmarks'] > 5
    assert 0.5 < figures['nis'] < 1.5


def test_no_report_is_replaced_unless_forced(slam_observer, report):
    recording = report.with_suffix('.mcap')
    assert 'exists already' in slam_observer.fail('replay', recording, '--report', report)
    slam_observer.succeed('replay', recording, '--report', report, '--force')


def test_growth_is_found_where_the_error_rises():
    seconds = np.arange(0.0, 200.0)
    errors_m = np.where(seconds < 120.0, 0.1, 1.0)
    (window,) = growth_windows(seconds, errors_m)
    assert window == (window[0], 120)
    assert 110 <= window[0] < 120


def test_a_browser_draws_it_without_an_error_and_asks_no_network(opened):
    assert opened.console == []
    assert opened.requested == []
    assert opened.html.count('class="main-svg"') >= 2
    assert 'stated 95 %' in opened.html


def test_a_request_to_the_network_would_be_noticed(tmp_path):
    page = tmp_path / 'page.html'
    page.write_text('<html><body><img src="http://127.0.0.1:9/x.png"></body></html>')
    assert open_page(page).requested


def test_the_slider_moves_to_the_time_in_the_address(report):
    t = numbers_of(report)['instants']['t'][-2]
    opened = open_page(report, f'#t={t}')
    readout = re.search(r'<output id="readout"[^>]*>([^<]*)', opened.html).group(1)
    assert readout.startswith(f'{t:.1f} s')


def run_in_page(report: Path, script: str) -> str:
    """Return the title that a script, run in a report after it was drawn, has given to it."""
    return re.search('<title>([^<]*)', opened_with(report, script).html).group(1)


def opened_with(report: Path, script: str) -> Opened:
    """Open a report with one script more, which runs after the report was drawn."""
    changed = report.with_name('changed.html')
    before, after = report.read_text().rsplit('</body>', 1)
    changed.write_text(f'{before}<script>{script}</script></body>{after}')
    opened = open_page(changed)
    assert opened.console == []
    return opened


@pytest.fixture(name='answers', scope='module')
def fixture_answers(reported):
    """What scripts, one after another in one page, say of a report."""
    blocks = [f'answers.{name} = (() => {{{code}}})();' for name, code in SCRIPTS.items()]
    title = 'document.title = JSON.stringify(answers);'
    script = 'const answers = {};' + ''.join(blocks) + title
    return json.loads(run_in_page(reported / 'run.html', script))


SCRIPTS = {
    'turned': """
        const side = document.getElementById('side'), turn = document.getElementById('turn');
        const seen = () => side.data.find((trace) => trace.name === 'estimate').x.slice();
        const before = seen();
        turn.value = '90';
        turn.dispatchEvent(new Event('input'));
        const after = seen(), xyz = run.path.xyz;
        const equal = (a, b) => a.every((v, n) => Math.abs(v - b[n]) < 1e-9);
        const hidden = document.getElementById('views').hidden;
        return [equal(before, xyz[0]), equal(after, xyz[1]), hidden];
    """,
    'ellipses': """
        const xs = [], ys = [];
        addEllipse(1, 2, [4, 0.5, 0.2, 1, 0.1, 9], PLAN, xs, ys);
        const distances = xs.slice(0, -1).map((x, n) => {
          const u = x - 1, v = ys[n] - 2;
          return (u * u - u * v + 4 * v * v) / (4 - 0.25);
        });
        return distances.every((d) => Math.abs(d - 5.991464547) < 1e-6);
    """,
    'interrupted': """
        run.gaps = [[2, 9]];
        return interrupted([0, 1, 2, 9, 10, 30], [5, 6, 7, 8, 9, 10]);
    """,
    'paper': """
        dispatchEvent(new Event('beforeprint'));
        const onPaper = document.querySelectorAll('#curves > div.js-plotly-plot').length;
        dispatchEvent(new Event('afterprint'));
        const curves = document.getElementById('curves').data;
        return [onPaper > 3, curves.length > onPaper];
    """,
    'life': """
        const lines = () => [...document.querySelectorAll('#life-table tbody tr')];
        document.querySelector('#landmarks tbody button').click();
        const shown = document.querySelector('#life h2').textContent;
        const whats = lines().map((line) => line.children[3].textContent);
        return [shown, document.getElementById('life').hidden, whats[0],
            whats.length > 10, whats.slice(1).every((what) => what.startsWith('used'))];
    """,
}


def test_motion_in_space_has_a_view_that_turns(report, answers):
    assert not numbers_of(report)['is_flat']
    assert answers['turned'] == [True, True, False]


def test_ellipses_hold_95_percent_in_any_view(answers):
    assert answers['ellipses']


def test_what_observations_show_is_no_line_across_the_time_without_any(answers):
    expected = [[0, 1, 2, None, 9, 10, 30], [5, 6, 7, None, 8, 9, 10]]
    assert answers['interrupted'] == expected


def test_on_paper_each_curve_is_a_figure_of_its_own(answers):
    assert answers['paper'] == [True, True]


def test_a_click_on_a_landmark_shows_what_came_of_each_observation(report, answers):
    (first, *_) = numbers_of(report)['landmarks']
    assert answers['life'] == [f'Landmark {first[0]}', False, 'new in the map', True, True]


def test_each_figure_is_saved_as_png_and_as_svg_with_white_paper(report):
    script = (
        f'const FIGURES = {list(FIGURES)};'
        + """
        const files = {}, found = [], names = [], made = URL.createObjectURL;
        URL.createObjectURL = (file) => {
          const url = made(file);
          files[url] = file;
          return url;
        };
        HTMLAnchorElement.prototype.click = function () {
          names.push(this.download);
          document.body.dataset.names = names.sort().join();
          files[this.href].text().then((text) => {
            const isSvg = text.startsWith('<svg');
            found.push(isSvg ? `svg ${text.includes('rgb(255, 255, 255)')}` : text.slice(1, 4));
            document.title = found.sort().join();
          });
        };
        FIGURES.forEach((figure) =>
          document.querySelectorAll(`#save-${figure} button`).forEach((button) => button.click()));
    """
    )
    opened = opened_with(report, script)
    saved = 'PNG,PNG,PNG,svg true,svg true,svg true'
    assert re.search('<title>([^<]*)', opened.html).group(1) == saved
    names = [f'run_{figure}.{kind}' for figure in FIGURES for kind in ('png', 'svg')]
    assert f'data-names="{",".join(names)}"' in opened.html


def test_a_figure_that_is_saved_is_what_is_seen(report):
    script = """
        Plotly.downloadImage = ({ data, layout }, { width, height, scale }) => {
          const map = document.getElementById('map');
          document.title = [layout.xaxis.range, data[1].visible, width === map.clientWidth,
            height === map.clientHeight, scale].join();
        };
        Plotly.relayout('map', { 'xaxis.range': [1, 2] }).then(() => {
          document.getElementById('map').data[1].visible = 'legendonly';
          document.querySelector('#save-map button').click();
        });
    """
    assert run_in_page(report, script) == '1,2,legendonly,true,true,3'


def test_what_is_smoothed_is_drawn_with_its_errors(slam_observer, reported, tmp_path):
    report = tmp_path / 'run.html'
    slam_observer.succeed('replay', reported / 'run.mcap', '--smooth', '--report', report)
    numbers = numbers_of(report)
    assert len(numbers['smoothed']['xyz'][0]) > 10
    assert len(numbers['smoothed']['points'][0]) == len(numbers['landmarks'])
    errors = numbers['errors']
    assert len(errors['smoothed_t']) == len(errors['smoothed_m']) > 10
    assert len(errors['smoothed_t']) == len(errors['smoothed_heading_deg'])
    html = open_page(report).html
    assert 'landmarks, smoothed' in html
    assert 'error of the smoothed path' in html


def test_errors_of_heading_and_configuration_are_drawn_where_there_is_truth(
    slam_observer, report, opened, tmp_path
):
    errors = numbers_of(report)['errors']
    assert len(errors['heading_t']) == len(errors['heading_deg']) > 10
    assert len(errors['configuration_t']) == len(errors['configuration_m']) > 10
    without_truth, other = write_events(tmp_path / 'a.mcap', events()), tmp_path / 'a.html'
    slam_observer.succeed('replay', without_truth, '--report', other)
    assert not {'heading_t', 'configuration_t', 'smoothed_t'} & set(numbers_of(other)['errors'])
    assert numbers_of(other)['smoothed'] is None
    assert 'heading [°]' in opened.html
    assert 'configuration [m]' in opened.html


def test_landmarks_that_are_believed_moved_are_marked(slam_observer, tmp_path):
    written, report = tmp_path / 'moved.mcap', tmp_path / 'moved.html'
    with RecordingWriter(written) as writer:
        for number, event in enumerate(events()):
            if isinstance(event, ObservationEvent) and number > MESSAGE_COUNT / 2:
                event = replace(event, points=event.points + [[0, 4, 0], [0, 0, 0], [0, 0, 0]])
            writer.write_event(event)
    assert slam_observer('replay', written, '--report', report).code == 0
    numbers = numbers_of(report)
    moved = {numbers['residuals']['id'][row] for row in numbers['residuals']['moved']}
    assert moved == {3}
    assert 'believed moved' in open_page(report).html


@pytest.mark.parametrize('kind', [RANGE, BEARING])
def test_distances_and_directions_alone_are_drawn(slam_observer, tmp_path, kind):
    known, report = tmp_path / 'known.yaml', tmp_path / 'run.html'
    recording = write_mcap(tmp_path / 'whole.mcap')
    slam_observer.succeed('replay', recording, '--map', known)
    halves = []
    for event in events():
        if isinstance(event, ObservationEvent):
            ranges = np.linalg.norm(event.points, axis=1)[:, None]
            points = ranges * [1.0, 0.0, 0.0] if kind == RANGE else event.points / ranges
            event = replace(event, points=points, kinds=np.full(len(points), kind))
        halves.append(event)
    options = ('--load-map', known, '--set', 'set_initial_pose=true', '--report', report)
    slam_observer('replay', write_events(tmp_path / 'half.mcap', halves), *options)
    instants = numbers_of(report)['instants']
    drawn, other = instants['rings'], instants['rays']
    drawn, other = (drawn, other) if kind == RANGE else (other, drawn)
    assert {len(each) for each in drawn} == {3}
    assert {len(each) for each in other} == {0}
    landmarks = np.transpose(instants['points'][5])
    if kind == RANGE:
        ring = np.array(instants['rings'][5])
        np.testing.assert_allclose(ring[:, :2], landmarks[:, :2], atol=1e-3)
        level = np.linalg.norm((landmarks - instants['xyz'][5])[:, :2], axis=1)
        np.testing.assert_allclose(ring[:, 2], level, atol=0.15)  # a step of the robot
        shown = 'stateAt(5, PLAN).x[4].filter((x) => x !== null)'
        opened = opened_with(report, f'document.title = {shown}')
        assert 'distances, directions' in opened.html
        xs = re.search('<title>([^<]*)', opened.html).group(1).split(',')
        edges = [*numbers_of(report)['path']['xyz'][0], *landmarks[:, 0]]
        assert min(edges) <= min(map(float, xs)) < max(map(float, xs)) <= max(edges)
    else:
        np.testing.assert_allclose(instants['rays'][5], landmarks, atol=0.15)


def test_landmarks_that_another_map_has_elsewhere_are_marked_while_it_fits(
    slam_observer, tmp_path
):
    """Of two posts 3 m apart one is in view for ten seconds, then a third landmark decides."""
    written, report = list[Event](), tmp_path / 'run.html'
    drive = Mock(add=lambda event: written.append(event) or True)
    posts = np.array([[5.0, 0.0, 0.0], [4.0, 3.0, 0.0], [1.0, 6.0, 0.0]])
    turned = se3.exp(np.array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0]))
    for step in range(100):
        creep(drive, 0.1 * step)
        if step < 20:
            observe(drive, 0.1 * step, posts)
    for step in range(10, 26):
        stand(drive, float(step))
        seen = se3.transform(se3.inverse(turned), posts)
        observe(drive, float(step), seen[1:2] if step < 20 else seen[1:])
    options = ('two_d_mode=true', 'confirmations=1', 'angular_velocity_noise=[0.0, 0.0, 0.1]')
    settings = [text for option in options for text in ('--set', option)]
    recording = write_events(tmp_path / 'posts.mcap', written)
    slam_observer('replay', recording, *settings, '--report', report)
    instants = numbers_of(report)['instants']
    marked = [t for t, rows in zip(instants['t'], instants['in_doubt'], strict=True) if rows]
    assert marked == [15.0, 16.0, 17.0, 18.0, 19.0]
    assert 'elsewhere in another map that fits' in open_page(report).html


def test_moving_the_slider_moves_the_robot(report):
    moved = report.with_name('moved.html')
    script = (
        "<script>const s = document.getElementById('slider'); s.value = '1';"
        "s.dispatchEvent(new Event('input')); setTimeout(() => {"
        "const d = document.getElementById('map').data; const n = d[d.length - 1];"
        'document.title = `robot at ${n.x[0]}`; }, 2000);</script></body>'
    )
    moved.write_text(script.join(report.read_text().rsplit('</body>', 1)))
    x = numbers_of(report)['instants']['xyz'][1][0]
    assert re.search('<title>([^<]*)', open_page(moved).html).group(1) == f'robot at {x}'


PHONE = """<body><iframe src="{}" style="width:390px;height:800px;border:0"></iframe><script>
addEventListener('message', (event) => {{ document.title = event.data; }});</script></body>"""


def test_a_phone_shows_all_columns_and_scrolls_in_one_direction(report_of_the_sample, tmp_path):
    report = Path(shutil.copy(report_of_the_sample, tmp_path))
    assert not numbers_of(report)['is_flat']
    script = """<script>
        const wide = document.getElementById('landmarks').parentElement;
        const page = document.documentElement;
        parent.postMessage([page.scrollWidth, page.clientWidth,
          wide.scrollWidth - wide.clientWidth, document.querySelectorAll('#landmarks th').length,
          document.querySelector('#side .main-svg').clientWidth].join(), '*');
    </script></body>"""
    report.write_text(script.join(report.read_text().rsplit('</body>', 1)))
    phone = tmp_path / 'phone.html'
    phone.write_text(PHONE.format(report.as_uri()))
    html = open_page(phone, '', '--allow-file-access-from-files').html
    width, window, hidden, columns, side = map(
        int, re.search('<title>([0-9,]*)', html)[1].split(',')
    )
    assert width <= window <= 390
    assert (hidden, columns) == (0, 9)
    assert 300 < side <= window


def test_the_side_view_is_as_wide_as_the_page_and_has_no_second_colour_bar(report_of_the_sample):
    script = """
        const width = (id) => document.querySelector(`#${id} .main-svg`).clientWidth;
        const bars = (id) => document.querySelectorAll(`#${id} .colorbar`).length;
        document.title = [width('side') === width('map'), bars('map'), bars('side')].join();
    """
    assert run_in_page(report_of_the_sample, script) == 'true,1,0'


def test_a_report_begins_with_that_nothing_was_used(slam_observer, tmp_path):
    recording, report = tmp_path / 'run.mcap', tmp_path / 'run.html'
    with RecordingWriter(recording) as writer:
        for event in events():
            if isinstance(event, ObservationEvent):
                event = replace(event, ids=event.ids, points=np.full_like(event.points, np.nan))
            writer.write_event(event)
    assert slam_observer('replay', recording, '--report', report).code == 0
    sentence = 'No observation was used (dropped: 50 without a point that is used'
    assert numbers_of(report)['findings'][0]['text'].startswith(sentence)
    shown = open_page(report).html
    assert shown.index(sentence) < shown.index('id="time-bar"')
