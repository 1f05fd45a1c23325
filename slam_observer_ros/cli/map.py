"""``slam-observer map``: maps of other programs, and what a map is worth without ids."""

from __future__ import annotations

import argparse
import math

from slam_observer_ros.cli import map_check
from slam_observer_ros.cli.console import print_table
from slam_observer_ros.cli.options import named, named_path
from slam_observer_ros.cli.outputs import add_force_option, check_inputs_are_kept, check_outputs
from slam_observer_ros.known_map.map_file import write_map
from slam_observer_ros.known_map.map_import import import_map, TAG_AXES


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = 'Make map files for map_file and --load-map, and check them.'
    actions = parser.add_subparsers(dest='action', required=True, metavar='ACTION')
    convert = actions.add_parser(
        'convert',
        help='make one of a table, of TagSLAM, a bundle of AprilTags or a field of FRC',
        description='CSV: id, x, y and, if known, z and sigma, with or without these names in '
        'the first line, and by name qx, qy, qz, qw, or the yaw in which an upright tag looks, '
        'and orientation_sigma; TagSLAM: the YAML file of bodies, or its output; the tag_bundles '
        'of apriltag_ros for ROS 1: poses in the frame of the bundle.',
    )
    convert.add_argument(
        'file', type=named_path, metavar='FILE', help='.csv, .tsv, .txt, .yaml or .json'
    )
    convert.add_argument('output', type=named_path, metavar='OUT.yaml', help='map file to make')
    convert.add_argument(
        '--frame', type=named, default='map', help='frame of the positions (default map)'
    )
    convert.add_argument(
        '--sigma',
        type=_deviation,
        default=0.02,
        metavar='M',
        help='standard deviation of coordinates that have none, metres (default 0.02)',
    )
    convert.add_argument(
        '--orientation-sigma',
        type=_deviation,
        default=0.03,
        metavar='RAD',
        help="that of a tag's orientation about each axis, radians (default 0.03: put up by eye)",
    )
    convert.add_argument(
        '--tag-axes',
        choices=tuple(TAG_AXES),
        default='right-up-out',
        help='x, y and z of a tag as your detector reports them, seen from before the tag '
        "(default right-up-out, as apriltag_ros's); none for positions only",
    )
    add_force_option(convert)
    convert.set_defaults(run=_run)
    map_check.add_options(
        actions.add_parser(
            'check',
            help='where one look finds a robot by landmarks without ids',
            description='Looks around from places all over a map, and says where the landmarks in '
            'view, without ids, say where the robot is.',
        )
    )


def _deviation(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f'{text} is no standard deviation')
    return value


def _run(args: argparse.Namespace) -> None:
    check_inputs_are_kept({'OUT.yaml': args.output}, {'what is converted': [args.file]})
    check_outputs([args.output], args.force)
    landmark_map = import_map(
        args.file, args.frame, args.sigma, args.orientation_sigma, args.tag_axes
    )
    write_map(args.output, landmark_map, None)
    low, high = landmark_map.world_points.min(axis=0), landmark_map.world_points.max(axis=0)
    spans = ', '.join(
        f'{axis} {lo:.2f} to {hi:.2f} m' for axis, lo, hi in zip('xyz', low, high, strict=True)
    )
    tags = len(landmark_map.tags)
    turned = f'{tags}, x y z of a tag: {args.tag_axes.replace("-", " ")}' if tags else 'none'
    found = {'landmarks': str(len(landmark_map.ids)), 'spans': spans, 'orientations': turned}
    print_table(str(args.output), found)
