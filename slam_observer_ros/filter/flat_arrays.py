"""Plain arrays and numbers that the step reads and writes: one layout in numpy and in C.

Arrays are contiguous, of float64 or int64. Frames and units are as in :mod:`.observer`.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from slam_observer_ros.common.types import FloatArray, IntArray


class FilterState(NamedTuple):
    """X̂ and the covariance P of its errors (ε, c̃, ξ_1 … ξ_n)."""

    A: FloatArray  # (4, 4) Â
    y_ref: FloatArray  # (n, 3) y_i° of the landmarks that P has
    a: FloatArray  # (n, 3) â_i, changed in place
    P: FloatArray  # (room, room) whose first N rows and columns count, changed in place
    size: int  # N
    first: int  # the first column of the landmarks; between p + c and it are postponed ones
    stride: int  # columns of a landmark, its point's first; none, 0, in an exact map
    is_planar: bool  # whether p is 3 and k is 2, in place of 6 and 3
    rates: FloatArray  # (6, 7) [M b] of velocities M V + b
    estimated: IntArray  # (c_v,) entries of it, row by row, that c̃ begins with; 42 is the delay
    drift: FloatArray  # (c, c) growth of the covariance of c̃ in a second
    # (n, 3) velocities of the landmarks, m/s, where these are estimated; their columns come last
    u: FloatArray | None


class Interval(NamedTuple):
    """The time of a motion, and how its velocity began."""

    start_ns: int
    end_ns: int
    delay_ns: int  # how much earlier the velocities were
    reach_ns: int  # how far the delay may be off, 0 where it is not estimated
    # (6,) mean velocity about the start, as the motion before has it about its end
    at_start: FloatArray | None


class Advanced(NamedTuple):
    """The effect of a motion, written by :func:`.advance`."""

    A: FloatArray  # (4, 4) Â at its end
    noise: FloatArray  # (p, p) added to the covariance of ε
    of_turning: FloatArray  # (p, p) the part of it that grows with the factor of turning
    sensitivity: FloatArray  # (p, c) F, how ε grows with the errors of the calibration
    at_end: FloatArray  # (6,) mean velocity about the end
    variances: FloatArray  # (6,) of the motion by axis, body frame, rad² and m²


class Seen(NamedTuple):
    """Points seen, body frame, and the sensor that saw them, if it is calibrated."""

    stamp_ns: int
    rows: IntArray  # (m,) which landmarks they are of, −1 where a landmark is not known yet
    arms: FloatArray  # (m, 3) from the sensor to each point, metres
    origins: FloatArray | None  # (m, 3) where the sensor was, metres; None at the base
    covariances: FloatArray | None  # (m, 3, 3) as stated, m²; None where the figures have them
    # (m, 3, 3) unit vectors along which points are measured, body frame, as rows, others zero;
    # None where all are measured along all
    directions: FloatArray | None
    sensor: FloatArray | None  # (7,) ψ, d and s of the sensor, rad and m
    of_sensor: IntArray  # (c_s,) which of ψ, d and s are estimated
    column: int  # of c̃ where they begin
    # (m, 3, c) how points change with the calibration, reference frame; None where the sensor
    # says that, or they don't
    D: FloatArray | None


class Limits(NamedTuple):
    """How far an observation is trusted."""

    gate: float  # standard deviations
    huber: float  # the same, 0 for none
    error_time_s: float  # correlation time of the errors of points
    confirmations: int  # observations that make a landmark sure
    max_rejections: int  # in a row, which make it doubtful
    may_refuse: int  # whether nothing is to be changed where most points are rejected


class Observed(NamedTuple):
    """The effect of an observation, written by :func:`.observe`."""

    A: FloatArray  # (4, 4) Â after it
    points: FloatArray  # (m, 3) where, by the calibration of the sensor, body frame
    r: FloatArray  # (m, 3) residuals (29)
    weights: FloatArray  # (m,) Huber's, 0 for a point that is rejected or of no known landmark
    origins: FloatArray  # (m, 3) where the sensor was, body frame
    lines_of_sight: FloatArray  # (m, 3) from the sensor to where each should be now
    # (m, 3, 3) of the points, body frame, m²; (0, 3, 3) where none were stated
    covariances: FloatArray
    repeated: FloatArray  # (m,) by what factor their covariances grow, as errors last
    moved: FloatArray  # (N,) −K r
    # (3 m + 1,) distances, logarithms of the densities and shares of m residuals, and the
    # normalised innovation squared of those used, zero at first; empty where nobody asks
    judged: FloatArray


class Tuning(Protocol):
    """What the filter is tuned by, as it is in force now: parameters of these names."""

    @property
    def rejection_threshold(self) -> float:
        """Gate, standard deviations."""

    @property
    def huber_threshold(self) -> float:
        """The same from which on weights fall, 0 for none."""

    @property
    def max_rejections(self) -> int:
        """Rejections in a row, which make a landmark doubtful."""

    @property
    def use_tag_orientation(self) -> bool:
        """Whether tags correct by how they are turned."""

    @property
    def landmark_velocity_stddev(self) -> float:
        """Of velocities that are estimated, m/s; 0 for none."""

    @property
    def gain_k(self) -> float:
        """Of constant gains: k (30), and so on."""

    @property
    def gain_l(self) -> float:
        """L (31)."""

    @property
    def step_mode(self) -> str:
        """'paper' or 'exponential'."""

    @property
    def max_innovation_time(self) -> float:
        """Time that an innovation acts at most, seconds."""
