"""Landmark observations from messages of detectors: poses, boxes and fiducials.

Messages are read from their bytes, so that none of the packages that define them is needed here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
import re

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import BEARING, MAX_ID, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.messages.cdr import Buffer, CdrReader
from slam_observer_ros.messages.clouds import is_measured, skip_cloud
from slam_observer_ros.messages.fiducials import as_arrays, NESTED, observed_poses, orientations_of
from slam_observer_ros.messages.poses import PoseMessage
from slam_observer_ros.messages.registry import Decoder, reads

APRILTAGS = 'apriltag_msgs/msg/AprilTagDetectionArray'  # ids of fiducials that /tf has
POSE_ARRAY = 'geometry_msgs/msg/PoseArray'
DETECTIONS = 'vision_msgs/msg/Detection3DArray'
BOXES = 'vision_msgs/msg/Detection2DArray'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
IN_IMAGES = (APRILTAGS, BOXES)  # types of pixels: directions by the camera's CameraInfo
_POSE = 7
_COVARIANCE = 36
_SIZE = 3
_CENTRE_AND_CORNERS = 10
_HOMOGRAPHY = 9
_BOX = 5  # centre, rotation and size
MAX_NAMES = 12  # names of frames that a log line lists
_TRAILING_NUMBER = re.compile(r'(?:.*\D)?(\d+)')
# A UUID, too. Names with a number, as ``facade12`` or ``b-000123``, have no letter after it.
_HASH = re.compile(r'(?<![^\W_])(?=.*\d[a-f])[\da-f-]{8,}\Z', re.IGNORECASE)
_HASH_LENGTH = 64  # no more of a name is searched: that takes the square of the length


@reads(
    APRILTAGS,
    role='landmarks',
    package='apriltag_ros',
    definition=(
        'std_msgs/Header header\nAprilTagDetection[] detections\n'
        f'{NESTED}apriltag_msgs/AprilTagDetection\nstring family\nint32 id\nint32 hamming\n'
        'float32 goodness\nfloat32 decision_margin\nPoint centre\nPoint[4] corners\n'
        f'float64[9] homography\n{NESTED}apriltag_msgs/Point\nfloat64 x\nfloat64 y\n'
    ),
)
def decode_apriltags(reader: CdrReader) -> ObservationEvent:
    """Read an apriltag_msgs/AprilTagDetectionArray: which fiducials are seen; /tf has where."""
    stamp_ns, frame_id = reader.header()
    families, tags = [], []
    for _ in range(reader.uint32()):
        families.append(reader.string())
        number = reader.int32()
        reader.int32()  # hamming distance
        reader.float32(2)  # goodness, decision margin
        tags.append((number, reader.float64(_CENTRE_AND_CORNERS + _HOMOGRAPHY)[:2]))
        if number < 0:
            raise MessageError(f'negative tag id {number}')
    ids, pixels = as_arrays(tags, 2)
    return ObservationEvent(
        stamp_ns,
        ids,
        np.full((len(ids), 3), np.nan),
        sensor_frame=frame_id,
        families=tuple(families),
        pixels=pixels,
    )


@reads(POSE_ARRAY, role='landmarks', is_ambiguous=True)
def decode_pose_array(reader: CdrReader) -> ObservationEvent:
    """Read a geometry_msgs/PoseArray, whose landmarks have no ids."""
    stamp_ns, frame_id = reader.header()
    poses = reader.float64(_POSE * reader.uint32()).reshape(-1, _POSE)
    ids = np.full(len(poses), UNKNOWN_ID, dtype=np.int64)
    return observed_poses(frame_id, stamp_ns, ids, poses)


@reads(
    DETECTIONS,
    role='landmarks',
    definition=(
        'std_msgs/Header header\nDetection3D[] detections\n'
        f'{NESTED}vision_msgs/Detection3D\nstd_msgs/Header header\n'
        'ObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n'
        f'{NESTED}vision_msgs/ObjectHypothesisWithPose\n'
        'ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n'
        f'{NESTED}vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n'
        f'{NESTED}vision_msgs/BoundingBox3D\n'
        'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n'
    ),
)
def decode_detections(reader: CdrReader) -> ObservationEvent:
    """Read a vision_msgs/Detection3DArray, since ROS 2 Galactic.

    The id of a landmark is the number that ends its detection's ``id``, or else its first
    result's ``class_id``: both are strings. No id are UUIDs, hashes, and numbers beyond
    ``MAX_ID``, as trackers give them. Its pose, with covariance if it is known of all, is that
    result's, or else, if that is missing or zero, the pose of the box's centre.
    """
    return _read_detections(reader, ('id',))


def _read_detections(
    reader: CdrReader, rest: Sequence[str], has_numbers: bool = False
) -> ObservationEvent:
    """Read detections with these fields behind their box."""
    stamp_ns, frame_id = reader.header()
    detections = [_read_detection(reader, rest, has_numbers) for _ in range(reader.uint32())]
    return observed_poses(frame_id, stamp_ns, *as_arrays(detections, _POSE + _COVARIANCE))


# Releases of vision_msgs until ROS 2 Foxy, by what is behind the box of a detection.
OTHER_DETECTIONS: dict[tuple[str, ...], tuple[str, Decoder[ObservationEvent]]] = {
    fields: (release, Decoder(partial(_read_detections, rest=fields, has_numbers=has_numbers)))
    for release, fields, has_numbers in (
        ('Foxy', ('source_cloud', 'is_tracking', 'tracking_id'), False),
        ('ROS 1', ('source_cloud',), True),  # whose classes are numbers
    )
}


def observed_tags(
    transforms: Iterable[PoseMessage], tag_frame_prefix: str
) -> list[ObservationEvent]:
    """Return what of /tf are sightings of fiducials: transforms from a camera to a tag.

    A tag's frame is the prefix and its id, or, as apriltag_ros has it, ``family:id``. What is
    no transform, and has NaN in it for example, is left out, and so are numbers beyond ``MAX_ID``.
    One measurement is returned for each camera and stamp.
    """
    # Other things have names with a colon, too, and longer numbers than a family has tags.
    pattern = re.compile(rf'{re.escape(tag_frame_prefix)}(\d+)|\w+:(\d{{1,9}})')
    seen = [
        (message, _landmark_id(match[1] or match[2]))
        for message in transforms
        if (match := pattern.fullmatch(message.child_frame_id)) and not message.problem
    ]
    by_camera: dict[tuple[str, int], list[tuple[int, FloatArray]]] = {}
    for message, number in seen:
        if number != UNKNOWN_ID:
            values = np.concatenate([message.position, message.quaternion])
            camera = message.frame_id, message.stamp_ns
            by_camera.setdefault(camera, []).append((number, values))
    events = []
    for (frame_id, stamp_ns), sightings in sorted(by_camera.items(), key=lambda item: item[0]):
        ids, poses = as_arrays(sightings, _POSE)
        R = orientations_of(poses[:, 3:])
        events.append(
            ObservationEvent(stamp_ns, ids, poses[:, :3], orientations=R, sensor_frame=frame_id)
        )
    return events


def no_tags(tag_frame_prefix: str, frames: Iterable[str]) -> str:
    """Say that no frame on /tf belongs to a fiducial, and what to do."""
    names = sorted(frames)
    there = ', '.join(names[:MAX_NAMES]) + (', …' if len(names) > MAX_NAMES else '')
    return (
        f"no frame on /tf is named '{tag_frame_prefix}<id>' or '<family>:<id>' "
        f'(there are {there}): set tag_frame_prefix'
    )


def _landmark_id(digits: str) -> int:
    """Return the number as an id, or the unknown id if it is beyond the largest one."""
    significant = digits.lstrip('0') or '0'
    if len(significant) > len(str(MAX_ID)):  # Python converts no number of thousands of digits.
        return UNKNOWN_ID
    return int(significant) if int(significant) <= MAX_ID else UNKNOWN_ID


def _read_detection(
    reader: CdrReader, rest: Sequence[str], has_numbers: bool
) -> tuple[int, FloatArray]:
    """Read a vision_msgs/Detection3D: id; position, quaternion and covariance (43,)."""
    reader.header()
    results = [_read_result(reader, has_numbers) for _ in range(reader.uint32())]
    centre, name = reader.float64(_POSE + _SIZE)[:_POSE], ''
    for field in rest:
        if field == 'source_cloud':
            skip_cloud(reader)
        elif field == 'is_tracking':
            reader.uint8()
        else:
            name = reader.string()
    if results and results[0][1][:3].any():
        return _id_of(name, results), results[0][1]
    # Detectors that fill in the box only leave the position of the result at zero.
    return _id_of(name, results), np.concatenate([centre, np.zeros(_COVARIANCE)])


def _id_of(name: str, results: Sequence[tuple[str, FloatArray]]) -> int:
    """Return the number that ends the id of a detection, or else its first result's class."""
    for text in (name, *(class_id for class_id, _ in results[:1])):
        match = _TRAILING_NUMBER.fullmatch(text)
        number = UNKNOWN_ID if match is None else _landmark_id(match[1])
        if number != UNKNOWN_ID and not _HASH.search(text[-_HASH_LENGTH:]):
            return number
    return UNKNOWN_ID


def _read_result(reader: CdrReader, has_numbers: bool) -> tuple[str, FloatArray]:
    """Read a vision_msgs/ObjectHypothesisWithPose: class; pose and covariance (43,)."""
    name = str(reader.int64(1)[0]) if has_numbers else reader.string()
    values = reader.float64(1 + _POSE + _COVARIANCE)[1:]  # the score comes first
    if values[_POSE] < 0.0:  # unknown
        values[_POSE:] = 0.0
    return name, values


@reads(
    BOXES,
    role='landmarks',
    definition=(
        'std_msgs/Header header\nDetection2D[] detections\n'
        f'{NESTED}vision_msgs/Detection2D\nstd_msgs/Header header\n'
        'ObjectHypothesisWithPose[] results\nBoundingBox2D bbox\nstring id\n'
        f'{NESTED}vision_msgs/ObjectHypothesisWithPose\n'
        'ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n'
        f'{NESTED}vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n'
        f'{NESTED}vision_msgs/BoundingBox2D\nPose2D center\nfloat64 size_x\nfloat64 size_y\n'
        f'{NESTED}vision_msgs/Pose2D\nPoint2D position\nfloat64 theta\n'
        f'{NESTED}vision_msgs/Point2D\nfloat64 x\nfloat64 y\n'
    ),
)
def decode_boxes(reader: CdrReader) -> ObservationEvent:
    """Read a vision_msgs/Detection2DArray: directions of boxes, ids as in a Detection3DArray."""
    stamp_ns, frame_id = reader.header()
    boxes = []
    for _ in range(reader.uint32()):
        reader.header()
        results = [_read_result(reader, False) for _ in range(reader.uint32())]
        centre = reader.float64(_BOX)[:2]
        boxes.append((_id_of(reader.string(), results), centre))
    ids, pixels = as_arrays(boxes, 2)
    event = ObservationEvent(
        stamp_ns,
        ids,
        np.full((len(ids), 3), np.nan),
        sensor_frame=frame_id,
        kinds=np.full(len(ids), BEARING),
        pixels=pixels,
    )
    return event.select(is_measured(pixels))


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """What a CameraInfo says: in which direction from a camera a pixel is.

    The image is rectified, or raw with the lens' distortion. Of both images a part may be sent,
    and each pixel be one of several.
    """

    rectified: FloatArray  # (4,) fx, fy, cx, cy, pixels of the whole image
    raw: FloatArray  # (4,) the same of the raw image
    model: str  # of the distortion, as sensor_msgs/distortion_models.hpp names it
    distortion: FloatArray
    binning: FloatArray  # (2,) how many pixels are one, horizontally and vertically
    offset: FloatArray  # (2,) first pixel that was sent

    def directions(self, pixels: FloatArray, *, is_rectified: bool) -> FloatArray:
        """Return unit vectors (m, 3), z forward, of pixels (m, 2); NaN where the lens has none."""
        figures = self.rectified if is_rectified else self.raw
        at = (pixels * self.binning + self.offset - figures[2:]) / figures[:2]
        if not is_rectified and self.distortion.any():
            if self.model == 'equidistant':
                return _from_fisheye(at, self.distortion)
            at = _undistorted(at, self.distortion, 0.1 / float(figures[:2].max()))
        lines = np.column_stack([at, np.ones(len(at))])
        directions: FloatArray = lines / np.linalg.norm(lines, axis=1)[:, None]
        return directions


POLYNOMIALS = ('plumb_bob', 'rational_polynomial', '')
MODELS = (*POLYNOMIALS, 'equidistant', 'none')
_ITERATIONS = 100
_MATRICES = (9, 9, 12)  # K, R and P


def decode_camera_info(raw: Buffer) -> tuple[str, Camera]:
    """Read a sensor_msgs/CameraInfo's frame and camera; MessageError if it isn't calibrated."""
    reader = CdrReader(raw)
    _, frame_id = reader.header()
    reader.uint32(), reader.uint32()  # height and width
    model = reader.string()
    distortion = reader.float64(reader.uint32())
    K, _, P = (reader.float64(size) for size in _MATRICES)
    binning = np.array([reader.uint32(), reader.uint32()], dtype=np.float64)
    offset = np.array([reader.uint32(), reader.uint32()], dtype=np.float64)
    reader.uint32(), reader.uint32(), reader.uint8()  # size of the part, whether it is rectified
    reader.finish()
    figures = K[[0, 4, 2, 5]]
    rectified = P[[0, 5, 2, 6]] if P[0] > 0.0 else figures
    numbers = np.concatenate([figures, rectified, distortion])
    if not (np.isfinite(numbers).all() and min(*figures[:2], *rectified[:2]) > 0.0):
        raise MessageError(f"the camera of '{frame_id}' is not calibrated: CameraInfo has no K")
    if distortion.any() and model not in MODELS:
        raise MessageError(f"the distortion model '{model}' is not one of {', '.join(MODELS)}")
    binning = np.maximum(binning, 1.0)  # zero means one
    return frame_id, Camera(rectified, figures, model, distortion, binning, offset)


def _distorted(at: FloatArray, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the radial factor (m, 1) and the tangential shift (m, 2) at x/z, y/z (m, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(distortion, (0, 8))[:8]
    x, y = at.T
    r2 = x**2 + y**2
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    shift_x = 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    shift_y = p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return radial[:, None], np.column_stack([shift_x, shift_y])


def _undistorted(shown: FloatArray, distortion: FloatArray, tolerance: float) -> FloatArray:
    """Return x/z, y/z (m, 2) that the lens shows there; NaN where none is within a tolerance."""
    with np.errstate(all='ignore'):
        at = shown
        for _ in range(_ITERATIONS):
            radial, shift = _distorted(at, distortion)
            at = (shown - shift) / radial
        radial, shift = _distorted(at, distortion)
        off = np.abs(radial * at + shift - shown).max(axis=1, initial=0.0)
        found: FloatArray = np.where((off < tolerance)[:, None], at, np.nan)
    return found


def _from_fisheye(shown: FloatArray, distortion: FloatArray) -> FloatArray:
    """Return unit vectors (m, 3) of a lens whose angle θ is shown at θ (1 + k₁θ² + …)."""
    k = np.pad(distortion, (0, 4))[:4]
    powers = 2 * np.arange(1, 5)
    radius = np.linalg.norm(shown, axis=1)
    with np.errstate(all='ignore'):
        angle = radius
        for _ in range(_ITERATIONS):
            squares = angle[:, None] ** powers
            slope = 1.0 + squares @ (k * (1 + powers))
            angle = angle - (angle * (1.0 + squares @ k) - radius) / slope
        off = np.abs(angle * (1.0 + angle[:, None] ** powers @ k) - radius)
        angle = np.where((off < 1e-6) & (angle >= 0.0) & (angle <= np.pi), angle, np.nan)
        around = np.where(radius[:, None] > 0.0, shown / radius[:, None], 0.0)
    return np.column_stack([np.sin(angle)[:, None] * around, np.cos(angle)])
