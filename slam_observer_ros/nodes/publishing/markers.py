"""Landmarks, their ids, uncertainties and residuals as RViz markers."""

from __future__ import annotations

from geometry_msgs.msg import Vector3
import numpy as np
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.nodes.message_classes import MESSAGES

POINT_SIZE_M = 0.2
TEXT_HEIGHT_M = 0.3
LINE_WIDTH_M = 0.03

GREEN = ColorRGBA(r=0.0, g=0.62, b=0.45, a=1.0)
WHITE = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
PALE_GREEN = ColorRGBA(r=0.0, g=0.62, b=0.45, a=0.3)
ORANGE = ColorRGBA(r=0.84, g=0.37, b=0.0, a=1.0)

MAX_LABELS = 200  # more could not be read, and each is a message of its own
ELLIPSOID_SIGMAS = 3.0  # half axes, in standard deviations
MIN_SIZE_M = 1e-3  # RViz complains about markers without a size


def landmark_markers(
    header: Header,
    ids: IntArray,
    points: FloatArray,
    covariances: FloatArray | None,
    update: Update | None,
) -> MarkerArray:
    """Return markers that replace all earlier ones, of landmarks (n,) in the header's frame.

    They are points, ids, the last residuals and, where covariances are known, ellipsoids.
    """
    if not len(points):
        return no_markers(header)
    labels = [
        _label(header, number, landmark_id, point)
        for number, (landmark_id, point) in enumerate(
            zip(ids[:MAX_LABELS].tolist(), points, strict=False)
        )
    ]
    lines = _residual_lines(header, ids, points, update)
    ellipsoids = _ellipsoids(header, points, covariances)
    drawn = [_points(header, points), lines, *ellipsoids, *labels]
    return MarkerArray(markers=[*no_markers(header).markers, *drawn])


def no_markers(header: Header) -> MarkerArray:
    """Return what removes all earlier markers."""
    return MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])


def _points(header: Header, points: FloatArray) -> Marker:
    marker = _marker(header, 'landmarks', Marker.SPHERE_LIST, GREEN, POINT_SIZE_M)
    marker.points = [MESSAGES.point(point) for point in points]
    return marker


def _ellipsoids(
    header: Header, points: FloatArray, covariances: FloatArray | None
) -> list[Marker]:
    """Return an ellipsoid for each of the first landmarks; none where no covariance is known."""
    if covariances is None:
        return []
    variances, axes = np.linalg.eigh(covariances[:MAX_LABELS])
    axes *= np.linalg.det(axes)[:, None, None]  # a rotation, not a reflection
    sizes_m = 2.0 * ELLIPSOID_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    markers = []
    for number, (point, size, turn) in enumerate(zip(points, sizes_m, axes, strict=False)):
        marker = _marker(header, 'uncertainties', Marker.SPHERE, PALE_GREEN, MIN_SIZE_M)
        marker.id = number
        marker.pose.position = MESSAGES.point(point)
        marker.pose.orientation = MESSAGES.quaternion(turn)
        marker.scale = MESSAGES.vector(np.maximum(size, MIN_SIZE_M))
        markers.append(marker)
    return markers


def _residual_lines(
    header: Header, ids: IntArray, points: FloatArray, update: Update | None
) -> Marker:
    """Return a line from each landmark just seen to where it was seen."""
    marker = _marker(header, 'residuals', Marker.LINE_LIST, ORANGE, LINE_WIDTH_M)
    if update is not None:
        _, seen, rows = np.intersect1d(update.ids, ids, return_indices=True)
        ends = points[rows]
        lines = np.stack((ends, ends + update.residuals[seen]), axis=1).reshape(-1, 3)
        marker.points = [MESSAGES.point(point) for point in lines]
    return marker


def _label(header: Header, number: int, landmark_id: int, point: FloatArray) -> Marker:
    marker = _marker(header, 'ids', Marker.TEXT_VIEW_FACING, WHITE, TEXT_HEIGHT_M)
    marker.id = number
    marker.text = str(landmark_id)
    marker.pose.position = MESSAGES.point(point)
    marker.pose.position.z += TEXT_HEIGHT_M
    return marker


def _marker(header: Header, namespace: str, kind: int, color: ColorRGBA, size_m: float) -> Marker:
    marker = Marker(header=header, ns=namespace, type=kind, action=Marker.ADD, color=color)
    marker.pose.orientation.w = 1.0
    marker.scale = Vector3(x=size_m, y=size_m, z=size_m)
    return marker
