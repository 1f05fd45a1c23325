"""``slam-observer`` refuses what is wrong in one line that helps, and stops cleanly."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from absent_packages import program_without
import pytest
import recordings

import slam_observer_ros
from slam_observer_ros.cli.options import find_config

CHECKOUT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, '-m', 'slam_observer_ros.cli.main']


@pytest.fixture
def recording(tmp_path):
    return recordings.write_mcap(tmp_path / 'run.mcap')


def test_version(slam_observer):
    assert slam_observer.succeed('--version').output == (
        f'slam-observer {slam_observer_ros.__version__}\n'
    )


def test_help_has_examples(slam_observer):
    output = slam_observer.succeed('--help').output
    for command in ('simulate', 'convert', 'map', 'replay'):
        assert f'slam-observer {command}' in output
        assert 'usage: ' in slam_observer.succeed(command, '--help').output


@pytest.mark.parametrize('command', ['simulate', 'replay'])
def test_help_names_what_a_robot_needs_first_before_the_advanced_parameters(
    slam_observer, command
):
    output = slam_observer.succeed(command, '--help').output
    first, advanced = output.index('parameters that a robot needs first'), output.index('advanced')
    assert first < output.index('two_d_mode') < advanced < output.index('gain_k')


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        ('', "arguments are required: COMMAND; see 'slam-observer --help'"),
        ('fly', "invalid choice: 'fly'"),
        ('replay', "required: RECORDING; see 'slam-observer replay --help'"),
        ('replay nothing.mcap', 'nothing.mcap: no such file or directory'),
        ('replay . --json', 'no rosbag2 directory'),
        ('replay nothing.mcap --jsn', "'--json'?; see 'slam-observer replay --help'"),
        ('replay nothing.mcap --gain constant', "--gain constant; did you mean '--gains'?"),
        ('replay nothing.mcap --params a.yaml', "--params a.yaml; see 'slam-observer replay"),
        ('replay nothing.mcap --gains best', "--gains: invalid choice: 'best'"),
        (
            'replay nothing.mcap --config nowhere',
            'with the package come: apriltags, bearings, floor_codes, localization',
        ),
        (
            'replay nothing.mcap --config nowhere/a.yaml',
            "can't read parameter file nowhere/a.yaml",
        ),
        ('replay nothing.mcap --config simulator', "has no '/**: ros__parameters:'"),
        ('replay nothing.mcap --config stereo_inertial.yaml', 'nothing.mcap: no such file'),
        ('replay nothing.mcap --config stereo.yaml', "can't read parameter file stereo.yaml"),
        ('replay nothing.mcap --set gain_k', '--set takes NAME=VALUE'),
        ('replay nothing.mcap --set gain_kk=1', "did you mean 'gain_k'?"),
        ('replay nothing.mcap --set gain_k=-1', "'gain_k' takes a value ≥ 1e-06"),
        ('replay nothing.mcap --set publish_rate=1', "that is the node's parameter"),
        ('replay nothing.mcap --set map_file=a.yaml', 'use --load-map'),
        ('replay nothing.mcap --tum nowhere/a.tum', 'there is no directory nowhere'),
        ('replay nothing.mcap --tum .', '. is a directory'),
        ('replay nothing.mcap --tum a --map a', 'a is named for two outputs'),
        ('simulate --plot nowhere/figures', 'there is no directory nowhere'),
        ('simulate --step 0', '--step takes seconds above 0'),
        ('simulate --step nan', '--step takes seconds above 0'),
        ('simulate --duration inf', '--duration takes seconds'),
        ('simulate --bias -1', "--bias: parameter 'initial_bias' takes a value ≥ 0"),
        ('simulate --landmarks 1.5', '--landmarks: parameter'),
        ('simulate --output run.bag', "recordings are .mcap files, so not 'run.bag'"),
        ('convert', 'required: WHAT'),
        ('convert kitti a b.mcap', "invalid choice: 'kitti'"),
        ('convert mrclam . a.mcap', 'required: --robot'),
        ('convert mrclam . a.mcap --robot 1', 'not an MRCLAM data set'),
        ('convert mrclam nowhere a.mcap --robot 1', 'nowhere: no such directory'),
        ('convert mrclam . a.mcap --robot 1 --measure azimuth', "invalid choice: 'azimuth'"),
        ('convert plaza nowhere a.mcap --run 1', 'nowhere: no such directory'),
        ('convert plaza . a.mcap --run 1', 'plaza1_dr.csv: no such file'),
        ('convert plaza . a.mcap', 'required: --run'),
        ('convert starry-night nowhere.mat a.mcap', 'nowhere.mat: no such file'),
        ('convert starry-night nowhere.mat a.bag', 'recordings are .mcap files'),
    ],
)
def test_wrong_use(slam_observer, tmp_path, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    assert reason in slam_observer.fail(*arguments.split())
    assert not list(tmp_path.iterdir())


def test_no_recording(slam_observer, tmp_path):
    path = tmp_path / 'notes.txt'
    path.write_text('hello')
    assert '.mcap, .db3' in slam_observer.fail('replay', path)
    path = tmp_path / 'notes.mcap'
    path.write_text('hello')
    assert str(path) in slam_observer.fail('replay', path)


def test_topic_that_is_not_there(slam_observer, recording):
    error = slam_observer.fail('replay', recording, '--landmarks-topic', '/tags')
    for text in ('/tags', '/twist', '/landmarks'):
        assert text in error


def test_output_that_exists(slam_observer, recording, data_dir):
    before = recording.read_bytes()
    file = data_dir / 'starry_night' / 'dataset3.mat'
    for command in (('simulate', '--output'), ('convert', 'starry-night', file)):
        assert '--force' in slam_observer.fail(*command, recording)
    assert 'give another name' in slam_observer.fail('replay', recording, '--tum', recording)
    assert recording.read_bytes() == before


def wait_until_ready(process: subprocess.Popen[str]) -> None:
    """Wait until the program handles SIGTERM: from then on it is at work."""
    mask = 1 << (signal.SIGTERM - 1)
    deadline = time.monotonic() + 60.0
    status = Path(f'/proc/{process.pid}/status')
    while time.monotonic() < deadline and process.poll() is None:
        caught = next(line for line in status.read_text().splitlines() if 'SigCgt' in line)
        if int(caught.split()[1], 16) & mask:
            return
        time.sleep(0.05)
    raise TimeoutError(process.args)


def test_figures_without_a_directory(slam_observer):
    error = slam_observer.fail('simulate', '--plot', '')
    assert 'argument --plot: the name is empty' in error


@pytest.mark.parametrize('stop', [signal.SIGINT, signal.SIGTERM])
def test_stopped_in_the_middle(tmp_path, stop):
    output = str(tmp_path / 'run.mcap')
    command = [*COMMAND, 'simulate', '--duration', '100000', '--json', '--output', output]
    with subprocess.Popen(
        command, cwd=CHECKOUT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        try:
            wait_until_ready(process)
            process.send_signal(stop)
            assert process.communicate(timeout=60) == ('', '')
        finally:
            process.kill()
    assert process.returncode == 128 + stop
    assert not list(tmp_path.iterdir())


def run_program(text):
    """Run the text of a program in the checkout, with its own interpreter."""
    return subprocess.run(
        [sys.executable, '-c', text],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


STOPPED_WHILE_A_CLASS_IS_DEFINED = """
import signal, sys
from slam_observer_ros.cli import doctor, main

class Attribute:
    def __set_name__(self, owner, name):
        signal.raise_signal(signal.{first})

def run(args):
    class Late:
        attribute = Attribute()

doctor.run = run
sys.exit(main.main(['doctor']))
"""


@pytest.mark.parametrize('stop', [signal.SIGINT, signal.SIGTERM])
def test_stopped_while_a_class_is_defined(stop):
    ended = run_program(STOPPED_WHILE_A_CLASS_IS_DEFINED.format(first=stop.name))
    assert (ended.returncode, ended.stderr) == (128 + stop, '')


STOPPED_TWICE = """
import atexit, signal, sys
from slam_observer_ros.cli import doctor, main

def run(args):
    try:
        signal.raise_signal(signal.{first})
    finally:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.{first})
        print('cleared away')

doctor.run = run
atexit.register(signal.raise_signal, signal.SIGINT)
sys.exit(main.main(['doctor']))
"""


@pytest.mark.parametrize('first', [signal.SIGINT, signal.SIGTERM])
def test_a_second_ctrl_c_disturbs_no_clearing_away(first):
    ended = run_program(STOPPED_TWICE.format(first=first.name))
    assert (ended.returncode, ended.stdout, ended.stderr) == (128 + first, 'cleared away\n', '')


@pytest.mark.parametrize('module', ['rich', 'numpy', 'scipy'])
def test_interrupted_while_modules_load_nothing_is_left(tmp_path, module):
    # Python itself makes such errors of an interrupt, in __set_name__.
    (tmp_path / f'{module}.py').write_text(
        'import signal\ntry:\n    signal.raise_signal(signal.SIGINT)\n'
        "except KeyboardInterrupt as error:\n    raise RuntimeError('in a library') from error\n"
    )
    search_path = os.pathsep.join([str(tmp_path), os.environ.get('PYTHONPATH', '')])
    (tmp_path / 'outputs').mkdir()
    output = tmp_path / 'outputs' / 'run.mcap'
    ended = subprocess.run(
        [*COMMAND, 'replay', 'samples/sample.mcap', '--mcap', output],
        cwd=CHECKOUT,
        env=os.environ | {'PYTHONPATH': search_path},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (128 + signal.SIGINT, '', '')
    assert not list(output.parent.iterdir())


@pytest.mark.parametrize(
    ('arguments', 'unneeded'),
    [
        (['--help'], {'numpy', 'scipy', 'matplotlib', 'rosbags', 'mcap'}),
        (['--version'], {'numpy', 'scipy', 'matplotlib', 'rosbags', 'mcap'}),
        (['convert', '--help'], {'matplotlib'}),
        (['replay', '--help'], {'matplotlib', 'scipy.spatial', 'rosbags.rosbag1'}),
        (['simulate', '--duration', '1', '--json'], {'matplotlib'}),
    ],
)
def test_what_is_not_needed_is_not_imported(arguments, unneeded):
    program = (
        'import sys\nfrom slam_observer_ros.cli.main import main\n'
        f'try:\n    main({arguments})\nexcept SystemExit:\n    pass\n'
        'print(*sys.modules, file=sys.stderr)'
    )
    ended = run_program(program)
    ended.check_returncode()
    assert ended.stdout
    assert not unneeded & set(ended.stderr.split())


@pytest.mark.parametrize('absent', ['rosbags', 'mcap', 'rich'])
def test_what_only_the_command_line_needs_is_named_when_missing(tmp_path, absent):
    program = program_without([absent], 'slam_observer_ros.cli.main', tmp_path)
    recording = CHECKOUT / 'samples/sample.mcap'
    if absent == 'rosbags':  # which MCAP files do without
        recording = tmp_path / 'other.db3'
        recording.write_bytes(b'SQLite format 3\0')
    ended = subprocess.run(
        [sys.executable, program, 'replay', str(recording)],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert f'{absent} is not installed' in line
    assert 'pip install rosbags mcap matplotlib rich' in line


def test_reader_that_leaves_early():
    reading, writing = os.pipe()
    os.close(reading)
    command = [*COMMAND, 'simulate', '--duration', '10', '--step', '1', '--json']
    with os.fdopen(writing, 'wb') as output:
        ended = subprocess.run(
            command,
            cwd=CHECKOUT,
            stdout=output,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
        )
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGPIPE, '')


@pytest.mark.parametrize('json', [[], ['--json']])
def test_closed_output(tmp_path, json):
    output = tmp_path / 'run.mcap'
    command = [*COMMAND, 'simulate', '--duration', '1', '--output', str(output), *json]
    ended = subprocess.run(
        ['sh', '-c', 'exec "$@" >&-', 'sh', *command],
        cwd=CHECKOUT,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (0, '')
    assert output.stat().st_size > 0


def test_configurations_are_found_wherever_pip_has_put_them(tmp_path, monkeypatch):
    site, share = tmp_path / 'lib' / 'site-packages', tmp_path / 'share' / 'slam_observer_ros'
    about = site / 'slam_observer_ros-1.0.dist-info'
    about.mkdir(parents=True)
    (about / 'METADATA').write_text('Name: slam_observer_ros\nVersion: 1.0\n')
    (about / 'RECORD').write_text('../../share/slam_observer_ros/config/blimp.yaml,,\n')
    (share / 'config').mkdir(parents=True)
    (share / 'config' / 'blimp.yaml').write_text('/**: {ros__parameters: {gains: constant}}\n')
    monkeypatch.syspath_prepend(str(site))
    assert find_config('blimp').samefile(share / 'config' / 'blimp.yaml')
