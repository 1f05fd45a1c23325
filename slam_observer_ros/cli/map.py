"""``slam-observer map``: maps of other programs, and what a map is worth without ids."""

from __future__ import annotations

import argparse
import math

import numpy as np

from slam_observer_ros.cli.console import print_table
from slam_observer_ros.cli.options import (
    add_force_option,
    check_inputs_are_kept,
    check_outputs,
    named,
    named_path,
)
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.mapping.map_alignment import Likeness
from slam_observer_ros.mapping.map_check import (
    look_around,
    Looks,
    place_for_another,
    symmetries,
)
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.mapping.map_import import import_map, LENGTHS, TAG_AXES
from slam_observer_ros.settings.estimator_settings import ERROR_PROBABILITY, Settings


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
        'file',
        type=named_path,
        metavar='FILE',
        help='.csv, .tsv, .txt, .yaml, .json, or .imk and .lmk of a navigation scanner',
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
    convert.add_argument(
        '--unit',
        choices=LENGTHS,
        help='of coordinates and their sigmas, where the file does not say (default m)',
    )
    add_force_option(convert)
    convert.set_defaults(run=_convert)
    _add_check_options(
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


def _convert(args: argparse.Namespace) -> None:
    check_inputs_are_kept({'OUT.yaml': args.output}, {'what is converted': [args.file]})
    check_outputs([args.output], args.force)
    landmark_map = import_map(
        args.file, args.frame, args.sigma, args.orientation_sigma, args.tag_axes, args.unit
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


def _add_check_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('file', type=named_path, metavar='MAP.yaml', help='map file')
    parser.add_argument(
        '--view',
        type=_metres,
        default=15.0,
        metavar='M',
        help='how far the sensor sees, metres (default 15)',
    )
    parser.add_argument(
        '--fov',
        type=_degrees,
        default=360.0,
        metavar='DEG',
        help='its field of view, degrees (default 360)',
    )
    parser.add_argument(
        '--sigma',
        type=_metres,
        default=0.02,
        metavar='M',
        help='standard deviation of each coordinate that it measures, metres (default 0.02)',
    )
    parser.add_argument(
        '--space', action='store_true', help='a robot that also rolls and pitches, not two_d_mode'
    )
    parser.add_argument(
        '--plot', type=named_path, metavar='OUT.png', help='picture of it to write'
    )
    add_force_option(parser)
    parser.set_defaults(run=_check)


def _check(args: argparse.Namespace) -> None:
    check_inputs_are_kept({'--plot': args.plot}, {'the map': [args.file]})
    check_outputs([args.plot], args.force)
    known, settings = read_map(args.file), Settings()
    known = known if args.space else known.flattened()
    looks = look_around(
        known,
        axes_of(not args.space),
        args.view,
        math.radians(args.fov),
        args.sigma,
        settings.map_noise,
        ERROR_PROBABILITY,
    )
    same = symmetries(known)
    another = place_for_another(known, same[0]) if same else None
    values = {'landmarks': str(len(known.ids))} | _values(looks, args.space)
    values['looks the same'] = _symmetry(same)
    if another is not None:
        values['one more landmark'] = f'at ({another[0]:.1f} m, {another[1]:.1f} m) would do'
    print_table(str(args.file), values)
    if args.plot:
        # matplotlib takes half a second to import.
        from slam_observer_ros.runs.figures import plot_map_check

        too_few = looks.fitting == 0
        places = looks.poses[:, :3, 3]
        plot_map_check(args.plot, known.world_points, places, looks.is_found, too_few, another)


def _values(looks: Looks, in_space: bool) -> dict[str, str]:
    """Return what looks from all over the map say."""
    found, least = looks.is_found, 4 if in_space else 3
    seen, too_few = looks.seen, looks.seen < least
    ambiguous = ~found & ~too_few
    values = {'looks': f'{len(seen)}, with {np.median(seen):.0f} landmarks in view (median)'}
    values['found by one look'] = f'{found.mean():.0%}'
    if found.any():
        values['found by one look'] += (
            f', by {seen[found].min()} landmarks or more, wrong with a probability of '
            f'{looks.error_probabilities[found].max():.0e} at most'
        )
    values['fits elsewhere, too'] = f'{ambiguous.mean():.0%}'
    values['too few in view'] = f'{too_few.mean():.0%} (fewer than {least})'
    return values


def _symmetry(same: list[Likeness]) -> str:
    """Return how the map may be turned and look the same."""
    if not same:
        return 'not when turned'
    best = same[0]
    differ = int(np.count_nonzero(~best.is_same))
    but = f' but for {differ} of its landmarks' if differ else ''
    return f'when turned by {best.turn_deg:.0f}°{but}'


def _metres(text: str) -> float:
    return _positive(text.removesuffix('m'), math.inf, f'{text} is no length in metres')


def _degrees(text: str) -> float:
    return _positive(text.removesuffix('°'), 360.0, f'{text} is no angle of up to 360 degrees')


def _positive(text: str, most: float, problem: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not (0.0 < value <= most and math.isfinite(value)):
        raise argparse.ArgumentTypeError(problem)
    return value
