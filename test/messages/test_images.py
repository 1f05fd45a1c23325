"""What an image shows is a direction, by the CameraInfo of its camera."""

from __future__ import annotations

import detector_messages as detector
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.events import BEARING, UNKNOWN_ID
from slam_observer_ros.messages.detections import (
    decode_apriltags,
    decode_boxes,
    decode_camera_info,
)

POINTS = np.array([[0.0, 0.0, 2.0], [1.0, -0.5, 2.0], [-1.2, 0.9, 3.0], [0.4, 0.3, 1.0]])
DIRECTIONS = POINTS / np.linalg.norm(POINTS, axis=1)[:, None]
BARREL = [-0.28, 0.07, 0.0002, 0.00002, -0.004]
RATIONAL = [0.2, 0.05, 0.0003, -0.0002, 0.01, 0.5, 0.1, 0.02]


def camera(*arguments, **figures):
    message = detector.camera_info('cam', *arguments, **figures)
    frame, known = decode_camera_info(ros.serialise(message))
    assert frame == 'cam'
    return known


def test_a_box_with_an_id_is_a_pixel_and_ids_are_numbers_that_end_a_name():
    seen = [('lamp_5', (400.0, 200.0)), ('', (1.0, 2.0)), ('7', (np.nan, 3.0))]
    event = decode_boxes(ros.serialise(detector.boxes(seen, 'cam')))
    assert (event.sensor_frame, event.stamp_ns) == ('cam', ros.STAMP_NS)
    assert_array_equal(event.ids, [5, UNKNOWN_ID])
    assert_array_equal(event.pixels, [[400.0, 200.0], [1.0, 2.0]])
    assert event.kinds.tolist() == [BEARING] * 2
    assert decode_boxes(ros.serialise(detector.boxes([], 'cam'))).pixels.shape == (0, 2)


def test_a_tags_centre_is_kept():
    message = detector.apriltags([('tag36h11', 5)], 'cam', centres=[(400.0, 200.0)])
    assert_array_equal(decode_apriltags(ros.serialise(message)).pixels, [[400.0, 200.0]])


@pytest.mark.parametrize('is_rectified', [True, False])
def test_a_pixel_is_a_direction_before_the_camera(is_rectified):
    directions = camera().directions(detector.pixels_of(POINTS), is_rectified=is_rectified)
    assert_allclose(directions, DIRECTIONS, atol=1e-12)


def test_pixels_of_a_part_and_of_several_count_in_the_whole_image():
    part = camera(binning=(2, 4), offset=(100, 40))
    pixels = (detector.pixels_of(POINTS) - [100, 40]) / [2, 4]
    assert_allclose(part.directions(pixels, is_rectified=True), DIRECTIONS, atol=1e-12)


@pytest.mark.parametrize(
    ('model', 'distortion'), [('plumb_bob', BARREL), ('rational_polynomial', RATIONAL)]
)
def test_the_lens_distortion_is_taken_out_of_the_raw_image(model, distortion):
    k1, k2, p1, p2, k3, k4, k5, k6 = [*distortion, 0.0, 0.0, 0.0][:8]
    x, y = (POINTS[:, :2] / POINTS[:, 2:]).T
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    shown = np.column_stack([
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        np.ones(len(x)),
    ])  # fmt: skip
    known = camera(model, distortion)
    found = known.directions(detector.pixels_of(shown), is_rectified=False)
    assert_allclose(found, DIRECTIONS, atol=2e-4)
    rectified = known.directions(detector.pixels_of(POINTS), is_rectified=True)
    assert_allclose(rectified, DIRECTIONS, atol=1e-12)


def test_a_fisheye_sees_to_the_side():
    k = [0.02, -0.003, 0.0005, -0.0001]
    angles = np.array([0.0, 0.3, 1.2, 1.65])
    shown = angles * (1 + sum(each * angles ** (2 * n) for n, each in enumerate(k, 1)))
    around = np.array([0.6, 0.8])
    pixels = shown[:, None] * around * detector.FOCAL_LENGTHS + detector.CENTRE
    found = camera('equidistant', k).directions(pixels, is_rectified=False)
    expected = np.column_stack([np.sin(angles)[:, None] * around, np.cos(angles)])
    assert_allclose(found, expected, atol=1e-6)


def test_what_a_lens_can_not_show_is_no_direction():
    known = camera('plumb_bob', [-0.5, 0.0, 0.0, 0.0])
    found = known.directions(np.array([[5000.0, 240.0], [330.0, 250.0]]), is_rectified=False)
    assert np.isnan(found).all(axis=1).tolist() == [True, False]


@pytest.mark.parametrize(
    ('figures', 'reason'),
    [
        ({'focal_lengths': (0.0, 0.0)}, "the camera of 'cam' is not calibrated"),
        ({'focal_lengths': (np.nan, 600.0)}, 'not calibrated'),
        ({'model': 'kannala', 'distortion': [0.1]}, "model 'kannala' is not one of plumb_bob"),
    ],
)
def test_a_camera_that_says_nothing_is_refused(figures, reason):
    with pytest.raises(MessageError, match=reason):
        camera(**figures)


def test_every_truncation_of_a_camera_info_is_refused():
    raw = ros.serialise(detector.camera_info('cam', distortion=BARREL))
    for size in range(len(raw)):
        with pytest.raises(MessageError):
            decode_camera_info(raw[:size])
