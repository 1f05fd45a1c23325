"""``slam-observer map``: maps of other programs, and what a map is worth without ids."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
import math

import numpy as np

from slam_observer_ros.cli.console import print_table
from slam_observer_ros.cli.options import check_outputs, FORCE, options
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.mapping.finder import look_around
from slam_observer_ros.mapping.map_alignment import place_for_another, symmetries
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.mapping.map_import import import_map, LENGTHS, TAG_AXES
from slam_observer_ros.settings.estimator_settings import ERROR_PROBABILITY, Settings


def _number(
    what: str, unit: str = '', most: float = math.inf, may_be_zero: bool = False
) -> Callable[[str], float]:
    """Return an argparse type that takes finite numbers above zero, with or without a unit."""

    def parse(text: str) -> float:
        with suppress(ValueError):
            value = float(text.removesuffix(unit))
            is_right = value > 0.0 or (may_be_zero and value == 0.0)
            if is_right and value <= most and math.isfinite(value):
                return value
        raise argparse.ArgumentTypeError(f'{text} is no {what}')

    return parse


_deviation = _number('standard deviation', may_be_zero=True)
_metres = _number('length in metres', 'm')
_degrees = _number('angle of up to 360 degrees', '°', 360.0)


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
    options(
        convert,
        f"""
        file FILE: .csv, .tsv, .txt, .yaml, .json, or .imk and .lmk of a navigation scanner
        output OUT.yaml: map file to make
        --frame FRAME: frame of the positions (default map)
        --sigma M: standard deviation of coordinates that have none, metres (default 0.02)
        --orientation-sigma RAD: standard deviation of a tag's orientation about each axis, radians
            (default 0.03: put up by eye)
        --tag-axes: x, y and z of a tag as your detector reports them, seen from before the tag
            (default right-up-out, as apriltag_ros's); none for positions only
        --unit: of coordinates and their sigmas, where the file does not say (default m)
        {FORCE}
        """,
        frame={'default': 'map'},
        sigma={'type': _deviation, 'default': 0.02},
        orientation_sigma={'type': _deviation, 'default': 0.03},
        tag_axes={'choices': tuple(TAG_AXES), 'default': 'right-up-out'},
        unit={'choices': LENGTHS},
    )
    convert.set_defaults(run=_convert)
    check = actions.add_parser(
        'check',
        help='where one look finds a robot by landmarks without ids',
        description='Looks around from places all over a map, and says where the landmarks in '
        'view, without ids, say where the robot is.',
    )
    options(
        check,
        f"""
        file MAP.yaml: map file
        --view M: how far the sensor sees, metres (default 15)
        --fov DEG: its field of view, degrees (default 360)
        --sigma M: standard deviation of each coordinate that it measures, metres (default 0.02)
        --space: a robot that also rolls and pitches, not two_d_mode
        --plot OUT.png: picture of it to write
        {FORCE}
        """,
        view={'type': _metres, 'default': 15.0},
        fov={'type': _degrees, 'default': 360.0},
        sigma={'type': _metres, 'default': 0.02},
    )
    check.set_defaults(run=_check)


def _convert(args: argparse.Namespace) -> None:
    check_outputs({'OUT.yaml': args.output}, args.force, {'what is converted': [args.file]})
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


def _check(args: argparse.Namespace) -> None:
    check_outputs({'--plot': args.plot}, args.force, {'the map': [args.file]})
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
    found, seen, least = looks.is_found, looks.seen, 4 if args.space else 3
    ambiguous = ~found & (seen >= least)
    by_one = f'{found.mean():.0%}'
    if found.any():
        by_one += (
            f', by {seen[found].min()} landmarks or more, wrong with a probability of '
            f'{looks.error_probabilities[found].max():.0e} at most'
        )
    values = {
        'landmarks': str(len(known.ids)),
        'looks': f'{len(seen)}, with {np.median(seen):.0f} landmarks in view (median)',
        'found by one look': by_one,
        'fits elsewhere, too': f'{ambiguous.mean():.0%}',
        'too few in view': f'{(seen < least).mean():.0%} (fewer than {least})',
        'looks the same': 'not when turned',
    }
    same = symmetries(known)
    another = place_for_another(known, same[0]) if same else None
    if same:
        differ = int(np.count_nonzero(~same[0].is_same))
        but = f' but for {differ} of its landmarks' if differ else ''
        values['looks the same'] = f'when turned by {same[0].turn_deg:.0f}°{but}'
    if another is not None:
        values['one more landmark'] = f'at ({another[0]:.1f} m, {another[1]:.1f} m) would do'
    print_table(str(args.file), values)
    if args.plot:
        # matplotlib takes half a second to import.
        from slam_observer_ros.runs.figures import plot_map_check

        too_few, places = looks.fitting == 0, looks.poses[:, :3, 3]
        plot_map_check(args.plot, known.world_points, places, found, too_few, another)
