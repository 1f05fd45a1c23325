"""``slam-observer convert``: public data sets as recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

from slam_observer_ros.cli.console import print_table
from slam_observer_ros.cli.options import named_path
from slam_observer_ros.cli.outputs import (
    add_force_option,
    check_inputs_are_kept,
    check_outputs,
    recording_path,
)
from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.recording.data_sets import load_mrclam, load_starry_night
from slam_observer_ros.recording.graph_files import load_graph
from slam_observer_ros.recording.writer import DataSet, write_data_set

GRAPH_PARAMETERS = """\
# A graph in the plane: the second that a pose takes is only a name for its step.
/**:
  ros__parameters:
    two_d_mode: true
    velocity_delay_stddev: 0.0  # s; no step is early or late
"""
"""What any graph takes to be replayed."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Make an MCAP recording, with TwistStamped, PointCloud2 and the truth, '
        'of a public data set.'
    )
    data_sets = parser.add_subparsers(dest='data_set', required=True, metavar='DATA-SET')
    starry_night = data_sets.add_parser(
        'starry-night', help='stereo camera and IMU moved by hand: dataset3.mat'
    )
    starry_night.add_argument('file', type=named_path, metavar='FILE', help='dataset3.mat')
    starry_night.set_defaults(run=_run, load=lambda args: load_starry_night(args.file))
    mrclam = data_sets.add_parser(
        'mrclam', help='wheeled robots among coded landmarks: MRCLAM_Dataset1 to 9'
    )
    mrclam.add_argument(
        'folder', type=named_path, metavar='FOLDER', help='such as MRCLAM_Dataset6'
    )
    mrclam.add_argument(
        '--robot', type=int, required=True, metavar='N', help='which robot, from 1 to 5'
    )
    mrclam.set_defaults(
        run=_run, file=None, truth=None, load=lambda args: load_mrclam(args.folder, args.robot)
    )
    graph = data_sets.add_parser(
        'graph', help='poses and points in the plane, in the text formats of iSAM and g2o'
    )
    graph.add_argument('file', type=named_path, metavar='FILE', help='such as victoria_park.txt')
    graph.add_argument(
        '--truth',
        type=named_path,
        metavar='FILE',
        help='the same graph with true, or the best, values',
    )
    graph.set_defaults(run=_run_graph, load=lambda args: load_graph(args.file, args.truth))
    for data_set in (starry_night, mrclam, graph):
        data_set.add_argument(
            'output', type=recording_path, metavar='OUT.mcap', help='recording to make'
        )
        add_force_option(data_set)


def _run_graph(args: argparse.Namespace) -> None:
    """Write a graph, and beside it the parameters without which its steps mean something else."""
    parameters: Path = args.output.with_suffix('.yaml')
    _check(args, parameters)
    rows = _written(args)
    try:
        with unfinished_file(parameters) as file:
            file.write(GRAPH_PARAMETERS)
    except OSError as error:
        raise OutputError(f"can't write {parameters}: {error.strerror}") from error
    rows['parameters, but for noise'] = f'--config {parameters}'
    print_table(str(args.output), rows)


def _run(args: argparse.Namespace) -> None:
    _check(args)
    print_table(str(args.output), _written(args))


def _check(args: argparse.Namespace, parameters: Path | None = None) -> None:
    given = (vars(args).get(name) for name in ('file', 'truth'))  # mrclam has a folder instead
    read = [file for file in given if file is not None]
    outputs = {'OUT.mcap': args.output, 'the file of parameters': parameters}
    check_inputs_are_kept(outputs, {'the data set': read})
    check_outputs(outputs.values(), args.force)


def _written(args: argparse.Namespace) -> dict[str, str]:
    """Write a recording; return what there is to say of it."""
    data_set: DataSet = args.load(args)
    write_data_set(data_set, args.output, args.force)
    rows = {
        'velocities': str(len(data_set.velocity_stamps_ns)),
        'observations': str(len(data_set.observations)),
        'true poses': str(len(data_set.truth_stamps_ns)),
        'true landmarks': str(len(data_set.landmarks.ids)),
    }
    rows |= {f'left out: {reason}': str(count) for reason, count in data_set.left_out.items()}
    return rows
