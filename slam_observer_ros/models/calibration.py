"""Calibration as part of the state: of the velocity, by axis, and of each sensor of landmarks.

V_true(t) = M V(t − τ) + b, where M has the scale factors 1 + s on its diagonal. A velocity shows
in observations later than its stamp, by the delay τ: a command takes a while to be obeyed, and an
image a while to be stamped. A sensor's part, ψ, d and s of
:mod:`slam_observer_ros.lie.sensor_mounting`, begins with the first observation from its
frame, and b, by which ranges from one landmark are too long, with the first of these.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import replace
import math
from typing import Any, NamedTuple, Protocol, TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_ns
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate, DELAY_NAME
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.sensor_mounting import Sensed
from slam_observer_ros.settings.estimator_settings import MAX_DELAY_S, Settings

if TYPE_CHECKING:
    from typing_extensions import Self

MOVES = 6  # column of b in [M b] (6, 7), which is multiplied by 1 where a velocity is not zero
# Where τ is, behind [M b] row by row. Then come, as they are first seen, ``EACH`` values of each
# sensor, and one of each landmark whose ranges have a bias.
DELAY, EACH = 42, 7

# Below zero as an odometry's velocity, averaged over the time before its stamp, shows earlier. How
# the robot moves so much later is not known yet when it is needed: without a limit the estimate,
# which can't make up for it, would stray ever further.
MIN_DELAY_S = -0.2


class Entry(NamedTuple):
    """A value that may be calibrated. ``parameter`` states it, ``parameter``_stddev how sure."""

    name: str
    parameter: str
    axis: int | None  # which of x, y and z of the parameter; None where that is one number
    place: int  # in [M b] and τ (43,), or in the values (7,) of a sensor
    unit: str


def _entries(parameter: str, places: Iterable[int]) -> list[Entry]:
    """Return what a parameter states of the values at ``places``: of one, or of x, y and z."""
    field = Settings.__dataclass_fields__[f'{parameter}_stddev']
    each = [('_x', 0), ('_y', 1), ('_z', 2)] if isinstance(field.default, tuple) else [('', None)]
    return [
        Entry(parameter + suffix, parameter, axis, place, field.metadata.get('unit', ''))
        for (suffix, axis), place in zip(each, places, strict=True)
    ]


_PLACES = np.arange(DELAY).reshape(6, 7)  # of [M b]
_SCALES, _BIASES = np.diagonal(_PLACES).tolist(), _PLACES[:, MOVES].tolist()
# All that may be calibrated of velocities, the delay last: one more entry of M is a row more.
OF_VELOCITY = (
    *_entries('angular_scale', _SCALES[:3]),
    *_entries('linear_scale', _SCALES[3:]),
    *_entries('angular_bias', _BIASES[:3]),
    *_entries('linear_bias', _BIASES[3:]),
    *_entries(DELAY_NAME, [DELAY]),
)

# All that may be calibrated of a sensor: ψ, d and e^s.
OF_SENSOR = (
    *_entries('sensor_rotation', range(3)),
    *_entries('sensor_translation', range(3, 6)),
    *_entries('range_scale', [SCALE := 6]),
)

# What may be of each landmark: by how much all ranges from it are too long.
(BIAS_OF_RANGES,) = _entries('range_bias', [0])

# Parameters that say how far these may be off, 0 for not at all.
VELOCITY_STDDEVS, SENSOR_STDDEVS = (
    tuple(dict.fromkeys(f'{entry.parameter}_stddev' for entry in entries))
    for entries in (OF_VELOCITY, (*OF_SENSOR, BIAS_OF_RANGES))
)


class CalibrationOwner(Protocol):
    """What has the values (43 + 7 s + b,) of velocities, of s sensors and of b landmarks."""

    calibration: FloatArray


class Calibration:
    """What an ``owner``'s values do, and which c of them are estimated: s, b and τ, then sensors'.

    These are the ones whose uncertainty is not 0. ``initial_variances`` (c,) grow by
    ``drift_covariance`` (c, c) a second, if one ``drifts``; ``delay_error_ns`` is the standard
    deviation of τ at the start, 0 where it is not estimated. ``sensors`` are the frames of those
    seen so far, and ``of_sensor`` (c_s,) says which of the seven values of each are estimated;
    ``corrects_points`` says whether what they show is not taken as it comes, and
    ``range_bias_m`` how far ranges from one landmark may be off.
    """

    def __init__(self, owner: CalibrationOwner, settings: Settings, axes: EstimatedAxes) -> None:
        self._owner, self.axes, self._settings = owner, axes, settings
        errors, is_possible = _of_velocity(settings, '_stddev'), np.zeros((6, 7))
        is_possible[axes.pose, axes.pose] = is_possible[axes.pose, MOVES] = 1.0
        errors[:DELAY] *= is_possible.ravel()
        self._entries = [entry for entry in OF_VELOCITY if errors[entry.place] > 0.0]
        self.velocity_places: IntArray = np.array([e.place for e in self._entries], dtype=np.int64)
        rates = self.velocity_places[self.velocity_places < DELAY]
        self._rows, self._columns = rates // 7, rates % 7
        turned, shifted = settings.sensor_rotation_stddev, settings.sensor_translation_stddev
        scaled = settings.range_scale_stddev / settings.range_scale
        deviations = np.array([*turned, *shifted, scaled])
        stated = np.append(np.zeros(6), math.log(settings.range_scale))
        of_sensor = np.append(np.arange(6)[axes.pose], SCALE)
        self.of_sensor: IntArray = of_sensor[deviations[of_sensor] > 0.0]
        self._stated, self._sensor_variances = stated, deviations[self.of_sensor] ** 2
        self._bias_variance = np.array([settings.range_bias_stddev**2])
        self.sensors: tuple[str, ...] = ()
        self.range_bias_m = settings.range_bias_stddev
        # Of frames and ids of landmarks: where their values begin, and their entries of the c.
        self._begins: dict[str | int, tuple[int, int]] = {}
        self.corrects_points = bool(
            settings.range_is_depth or stated.any() or len(self.of_sensor) or self.range_bias_m
        )
        self.delay_error_ns = to_ns(settings.velocity_delay_stddev)
        self.of_velocity = len(self.velocity_places)  # how many of the c are no sensor's
        # (c,) which of the values these are, and all as they were at the start
        self._places, self._nominal = self.velocity_places, stated_of_velocity(settings)
        owner.calibration = self._nominal.copy()
        self._set_variances(errors[self._places] ** 2)

    def of(self, owner: CalibrationOwner) -> Self:
        """Return the calibration of a copy of the owner."""
        other = copy(self)
        other._owner = owner
        return other

    def _set_variances(self, variances: FloatArray) -> None:
        self.count, self.initial_variances = len(variances), variances
        self.drift_covariance = np.diag(variances * self._settings.calibration_drift**2)
        self.drifts = bool(self.drift_covariance.any())

    def add(self, of: str | int) -> FloatArray:
        """Append the estimated entries of a new frame's sensor; return their variances (c_s,).

        Or the bias of ranges from a landmark, by its id.
        """
        if isinstance(of, str):
            stated, estimated, variances = self._stated, self.of_sensor, self._sensor_variances
            entries = [OF_SENSOR[each] for each in estimated]
            self.sensors = (*self.sensors, of)
        else:
            stated, estimated, variances = np.zeros(1), np.zeros(1, int), self._bias_variance
            entries = [BIAS_OF_RANGES]
        owner, first = self._owner, len(self._nominal)
        self._begins = {**self._begins, of: (first, self.count)}
        named = [each._replace(name=f'{each.name}/{of}') if of != '' else each for each in entries]
        self._entries = [*self._entries, *named]  # a copy has the list, too
        self._places = np.append(self._places, first + estimated)
        self._nominal = np.append(self._nominal, stated)
        owner.calibration = np.append(owner.calibration, stated)
        self._set_variances(np.append(self.initial_variances, variances))
        return np.asarray(variances)

    @property
    def values(self) -> FloatArray:
        """(c,) estimates: scale factors 1 + s, biases b, the delay τ in seconds; then sensors'."""
        return self._owner.calibration.take(self._places)

    @property
    def rates(self) -> FloatArray:
        """(6, 7) [M b], as a view."""
        return self._owner.calibration[:DELAY].reshape(6, 7)

    @property
    def delay_ns(self) -> int:
        """The delay τ; where it is negative the latest velocity is held for longer."""
        return round(float(self._owner.calibration[DELAY]) * NANOSECONDS_PER_SECOND)

    @property
    def calibrates_sensors(self) -> bool:
        """Whether some of the c entries belong to sensors."""
        return self.count > self.of_velocity

    def sensor(self, frame: str) -> FloatArray:
        """Return ψ, d and s (7,) of a sensor, as a view."""
        first, _ = self._begins[frame]
        return self._owner.calibration[first : first + EACH]

    def columns(self, frame: str) -> slice:
        """Return which of the c entries belong to a sensor."""
        _, first = self._begins[frame]
        return slice(first, first + len(self.of_sensor))

    def new_anchors(self, ids: IntArray) -> list[int]:
        """Return the landmarks among ``ids`` (m,) whose ranges have no bias yet, each once."""
        return sorted({*ids.tolist()} - {-1} - self._begins.keys())

    def biases(self, ids: IntArray) -> tuple[FloatArray, IntArray]:
        """Return by how much ranges from landmarks (m,) are too long, metres, 0 where none is.

        And which of the c entries that is, −1 for none.
        """
        begins = [self._begins.get(each, (-1, -1)) for each in ids.tolist()]
        places, columns = np.array(begins, dtype=np.int64).reshape(-1, 2).T
        biases = np.where(places < 0, 0.0, self._owner.calibration[places])
        return biases, columns

    def sensor_columns(self, sensed: Sensed) -> tuple[Sensed, FloatArray, IntArray]:
        """Return ψ, d, s and b (s, 8) of all sensors, and which of the c entries they are, or −1.

        Each landmark whose ranges have a bias makes another sensor of the one that showed it.
        """
        count = len(self.sensors)
        pairs, numbers = np.unique(
            sensed.sensors + count * (sensed.anchors + 1), return_inverse=True
        )
        anchors, sensors = np.divmod(pairs, count)
        values, columns = np.zeros((len(pairs), EACH + 1)), np.full((len(pairs), EACH + 1), -1)
        values[:, EACH], columns[:, EACH] = self.biases(anchors - 1)
        for row, sensor in enumerate(sensors.tolist()):
            frame = self.sensors[sensor]
            values[row, :EACH], of = self.sensor(frame), self.columns(frame)
            columns[row, self.of_sensor] = np.arange(of.start, of.stop)
        return replace(sensed, sensors=numbers), values, columns

    def estimates(
        self, variances: FloatArray, values: FloatArray | None = None
    ) -> list[CalibrationEstimate]:
        """Return the estimates, or ``values`` (c,), with the filter's ``variances`` (c,)."""
        values = self.values if values is None else values
        stated = np.full(self.count, np.inf) if self.drifts else np.sqrt(self.initial_variances)
        estimates = []
        for place, entry, value, variance, known in zip(
            self._places.tolist(), self._entries, values, variances, stated, strict=True
        ):
            nominal, factor = self._nominal[place], 1.0
            if entry.parameter == 'range_scale':  # s is its logarithm
                value, nominal = math.exp(value), math.exp(nominal)
                factor = value
            estimates.append(
                CalibrationEstimate(
                    entry.name,
                    float(value),
                    float(factor * np.sqrt(variance)),
                    entry.unit,
                    nominal=float(nominal),
                    stated=float(factor * known),
                )
            )
        return estimates

    def apply(self, body_velocities: FloatArray) -> FloatArray:
        """Return velocities (…, 6) as M V + b; exact zeros stay so."""
        return calibrated(self.rates, body_velocities)

    def apply_to_covariance(
        self, covariance: FloatArray, body_velocity: FloatArray, variances: FloatArray
    ) -> FloatArray:
        """Return a calibrated velocity's covariance (6, 6), by its own and ``variances`` (c,)."""
        M = self.rates[:, :MOVES]
        applied: FloatArray = M @ covariance @ M.T
        shares = variances[: len(self._rows)] * self._rates(body_velocity[None])[0] ** 2
        applied.ravel()[::7] += np.bincount(self._rows, shares, minlength=6)
        return applied

    def _rates(self, measured_velocities: FloatArray) -> FloatArray:
        """Return (k, …) how fast each entry of [M b] moves the robot per unit of its error."""
        return with_moves(measured_velocities).take(self._columns, axis=1)

    def at_rest(self, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how fast the robot turns by a gyroscope's ``rate`` (3,): (q,), and H (q, c).

        About the q axes of turns; H is how fast it turns per unit of an error. Where it stands,
        that is how far the estimates are off.
        """
        velocity, H = np.append(rate, np.zeros(3)), np.zeros((6, self.count))
        H[self._rows, np.arange(len(self._rows))] = self._rates(velocity[None])[0]
        # Nothing else than a bias turns a robot that stands.
        is_bias = self._columns == MOVES
        H[~np.isin(np.arange(6), self._rows[is_bias])] = 0.0
        turned = np.arange(3)[self.axes.pose]
        return self.apply(velocity)[turned], H[turned]

    def initial_covariance(self) -> FloatArray:
        """Return the covariance (p + c, p + c) of (ε, c̃) at the start, without error of Â."""
        return np.diag(np.append(np.zeros(self.axes.p), self.initial_variances))

    def shift(self, change: FloatArray) -> None:
        """Add ``change`` (c,) to the estimates."""
        self._owner.calibration[self._places] = self.shifted(change)

    def shifted(self, change: FloatArray) -> FloatArray:
        """Return the estimates (c,) after that; the delay stays within what can be made up for."""
        values: FloatArray = self._owner.calibration[self._places] + change
        if self.delay_error_ns:
            least_s = min(MIN_DELAY_S, self._nominal[DELAY])
            delay = self.of_velocity - 1
            values[delay] = min(max(values[delay], least_s), MAX_DELAY_S)
        return values


def with_moves(body_velocities: FloatArray) -> FloatArray:
    """Return (V, 1) (…, 7) of velocities V (…, 6), or zero where these are exactly zero."""
    velocities = np.empty((*body_velocities.shape[:-1], 7))
    velocities[..., :MOVES] = body_velocities
    velocities[..., MOVES] = _moves(body_velocities)
    return velocities


def _moves(body_velocities: FloatArray) -> BoolArray:
    """Return whether velocities (…, 6) are not exactly zero (…)."""
    return np.asarray(body_velocities.any(axis=-1))


def calibrated(rates: FloatArray, body_velocities: FloatArray) -> FloatArray:
    """Return velocities (…, 6) as M V + b, of [M b] (6, 7); exact zeros stay so."""
    # Wheels that stand turn no robot, however unlike, and no gyroscope gives zero on all axes.
    biases = _moves(body_velocities)[..., None] * rates[:, MOVES]
    velocities: FloatArray = body_velocities @ rates[:, :MOVES].T + biases
    return velocities


def stated_of_velocity(settings: Settings) -> FloatArray:
    """Return what the settings state of the velocity (43,): [M b] and τ."""
    return _of_velocity(settings, '')


def _of_velocity(settings: Settings, suffix: str) -> FloatArray:
    """Return what the parameters whose names end in ``suffix`` say of [M b] and τ (43,)."""
    values = np.zeros(DELAY + 1)
    for entry in OF_VELOCITY:
        stated = getattr(settings, entry.parameter + suffix)
        values[entry.place] = stated if entry.axis is None else stated[entry.axis]
    return values


def without_calibration(settings: Settings) -> Settings:
    """Return settings that estimate nothing of the calibration, as stated as it may be."""
    zero: dict[bool, Any] = {True: (0.0, 0.0, 0.0), False: 0.0}
    stddevs = (*SENSOR_STDDEVS, *VELOCITY_STDDEVS)
    are_vectors = {name: isinstance(getattr(settings, name), tuple) for name in stddevs}
    return replace(settings, **{name: zero[is_vector] for name, is_vector in are_vectors.items()})
