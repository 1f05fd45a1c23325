"""``slam-observer convert``: public data sets as recordings, poses of recordings as TUM files."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np

from slam_observer_ros.cli.console import print_table
from slam_observer_ros.cli.options import check_outputs, FORCE, options
from slam_observer_ros.common.errors import failing, OutputError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.common.findings import found
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import write_map
from slam_observer_ros.recordings.data_sets import (
    load_graph,
    load_mrclam,
    load_plaza,
    load_starry_night,
    MEASURES,
)
from slam_observer_ros.recordings.opening import files_of
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import pose_topic
from slam_observer_ros.recordings.trajectory import LandmarkTruth, write_tum
from slam_observer_ros.recordings.writer import DataSet, write_data_set

logger = logging.getLogger(__name__)

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
        'of a public data set; or, by tum, a TUM file of the poses of a topic, such as the true '
        'ones.'
    )
    data_sets = parser.add_subparsers(dest='data_set', required=True, metavar='WHAT')
    starry_night = data_sets.add_parser(
        'starry-night', help='stereo camera and IMU moved by hand: dataset3.mat'
    )
    options(starry_night, 'file FILE: dataset3.mat')
    starry_night.set_defaults(load=lambda args: load_starry_night(args.file))
    mrclam = data_sets.add_parser(
        'mrclam', help='wheeled robots among coded landmarks: MRCLAM_Dataset1 to 9'
    )
    options(
        mrclam,
        """
        folder FOLDER: such as MRCLAM_Dataset6
        --robot N: which robot, from 1 to 5
        --measure: leave only directions or distances of the landmarks (default point: both)
        """,
        robot={'required': True},
        measure={'choices': tuple(MEASURES), 'default': 'point'},
    )
    mrclam.set_defaults(load=lambda args: load_mrclam(args.folder, args.robot, args.measure))
    plaza = data_sets.add_parser(
        'plaza',
        help='a mower among radios that give distances: plazaN_dr.csv, _td, _gt and _tl',
        description='Columns below a line of their names, N being the run: plazaN_dr.csv, the way '
        'since the row before: t (s), forward (m), turn (rad); plazaN_td.csv, distances: t, '
        'sender, anchor, range (m); and, if they are there, plazaN_gt.csv, true poses: t, x, y, '
        'yaw, and plazaN_tl.csv, radios: anchor, x, y. OUT.yaml is made, too: the map of these.',
    )
    options(
        plaza,
        """
        folder FOLDER: of these files
        --run N: 1 or 2
        """,
        run={'required': True, 'dest': 'number'},
    )
    plaza.set_defaults(load=lambda args: load_plaza(args.folder, args.number))
    graph = data_sets.add_parser(
        'graph', help='poses and points in the plane, in the text formats of iSAM and g2o'
    )
    options(
        graph,
        """
        file FILE: such as victoria_park.txt
        --truth FILE: the same graph with true, or the best, values
        """,
    )
    graph.set_defaults(load=lambda args: load_graph(args.file, args.truth))
    for data_set in (starry_night, mrclam, plaza, graph):
        beside = {plaza: _write_survey, graph: _write_parameters}.get(data_set)
        data_set.set_defaults(run=_run, write_beside=beside)
        options(data_set, f'output OUT.mcap: recording to make\n{FORCE}')
    tum = data_sets.add_parser('tum', help='poses of a topic of a recording, as evo reads them')
    options(
        tum,
        f"""
        file RECORDING: as replay reads it
        output OUT.tum: TUM file to make
        --topic TOPIC: poses or odometry; by default the true poses, as replay finds them
        --base-frame FRAME: move poses that are of another frame to this one, by /tf_static
        {FORCE}
        """,
    )
    tum.set_defaults(run=_run_tum)


def _run_tum(args: argparse.Namespace) -> None:
    """Write the poses of a topic."""
    read = {f'the recording {args.file}': files_of(args.file)}
    check_outputs({'OUT.tum': args.output}, args.force, read)
    with Recording(args.file) as recording:
        topic = pose_topic(recording.topics, args.topic)
        trajectory = recording.trajectory(topic, args.base_frame or '')
        if recording.warning:
            logger.warning('%s', found('incomplete_recording', problem=recording.warning))
    write_tum(trajectory, args.output)
    print_table(str(args.output), {'topic': str(topic), 'poses': str(len(trajectory))})


SURVEY_M = 0.05  # standard deviation of coordinates of Plaza's radios, which were surveyed by GPS


def surveyed(landmarks: LandmarkTruth) -> LandmarkMap:
    """Return the map of Plaza's radios, as uncertain as they were surveyed."""
    count = len(landmarks.ids)
    covariances, never = np.tile(SURVEY_M**2 * np.eye(3), (count, 1, 1)), np.zeros(count, np.int64)
    return LandmarkMap(landmarks.ids, landmarks.world_points, covariances, never)


def _run(args: argparse.Namespace) -> None:
    """Write a recording, and beside it what it takes to be replayed."""
    given = (vars(args).get(name) for name in ('file', 'truth'))  # others have a folder instead
    read = [file for file in given if file is not None]
    beside = None if args.write_beside is None else args.output.with_suffix('.yaml')
    outputs = {'OUT.mcap': args.output, 'the file beside it': beside}
    check_outputs(outputs, args.force, {'the data set': read})
    data_set: DataSet = args.load(args)
    write_data_set(data_set, args.output, args.force)
    rows = {
        'velocities': str(len(data_set.velocity_stamps_ns)),
        'observations': str(len(data_set.observations)),
        'true poses': str(len(data_set.truth_stamps_ns)),
        'true landmarks': str(len(data_set.landmarks.ids)),
    }
    rows |= {f'left out: {reason}': str(count) for reason, count in data_set.left_out.items()}
    if beside is not None:
        rows |= args.write_beside(beside, data_set)
    print_table(str(args.output), rows)


def _write_parameters(path: Path, _: DataSet) -> dict[str, str]:
    """Write the parameters without which the steps of a graph mean something else."""
    with failing(OutputError, f"can't write {path}"), unfinished_file(path) as file:
        file.write(GRAPH_PARAMETERS)
    return {'parameters, but for noise': f'--config {path}'}


def _write_survey(path: Path, data_set: DataSet) -> dict[str, str]:
    """Write the survey of Plaza's radios, and return where the mower began."""
    if not (len(data_set.landmarks.ids) and len(data_set.true_poses)):
        return {}
    write_map(path, surveyed(data_set.landmarks), None)
    start = data_set.true_poses[0]
    yaw = float(np.arctan2(start[1, 0], start[0, 0]))
    return {
        'survey, and where it begins': f'--load-map {path} --set set_initial_pose=true '
        f'--set initial_pose=[{start[0, 3]:.3f},{start[1, 3]:.3f},0.0,0.0,0.0,{yaw:.4f}] '
    }
