"""The estimator's settings: one table for the node, YAML files, the command line and docs."""

from __future__ import annotations

from dataclasses import dataclass, fields, InitVar

from slam_observer_ros.settings.parameter_table import parameter, Pose6

Vector3 = tuple[float, float, float]


MAX_DELAY_S = 1.0  # delay of velocities that is made up for at most
ERROR_PROBABILITY = 1e-3  # of a wrong place in a loaded map, where points have no ids
MAX_POSITION_M = 1e7  # coordinate of a given pose at most: a map's origin may be UTM's


@dataclass(frozen=True)
class Settings:
    """Settings of the estimator; each field is a parameter."""

    # fmt: off
    gains: str = parameter(
        'riccati', 'What sets the gains: two numbers (constant) or the covariance of all errors '
        '(riccati)', choices=('constant', 'riccati'), basic=True)
    two_d_mode: bool = parameter(
        False, 'Whether motion and map are planar: z, roll and pitch stay exactly zero',
        basic=True)
    gain_k: float = parameter(
        4.0, 'Constant gains: k of (30), with metres: how fast the pose follows residuals',
        unit='1/s', minimum=1e-6, maximum=1e6, read_only=False)
    gain_l: float = parameter(
        1.0, "Constant gains: l of (31); a landmark's residual decays at the rate l/k",
        unit='1/s²', minimum=0.0, maximum=1e6, read_only=False)
    step_mode: str = parameter(
        'exponential', "Constant gains: discrete step; 'paper' converges to the paper's equation "
        'for small steps', choices=('exponential', 'paper'), read_only=False)
    max_innovation_time: float = parameter(
        0.2, 'Constant gains: an observation acts for the time since its landmark was last seen, '
        'at most this long', unit='s', minimum=1e-3, maximum=3600.0, read_only=False)
    velocity_timeout: float = parameter(
        1.0, 'How long a velocity is held; then the pose is held and flagged as stale',
        unit='s', minimum=1e-3, maximum=3600.0)
    reorder_window: float = parameter(
        0.05, 'How long events are held back at most, to be put in stamp order: after 10 s twice '
        'as long as any was late in the last 10 s',
        unit='s', minimum=0.0, maximum=10.0, basic=True)
    late_limit: float = parameter(
        2.0, 'How late an event may come after the reorder window: an observation is carried '
        'forward, a velocity counts from then on, unless a newer one of its kind was used',
        unit='s', minimum=0.0, maximum=60.0)
    max_stamp_jump: float = parameter(
        10.0, 'A stamp further ahead of all others is refused until others confirm it',
        unit='s', minimum=0.1, maximum=1e9)
    max_linear_velocity: float = parameter(
        100.0, 'Speed beyond which a velocity is refused (too_fast)',
        unit='m/s', minimum=1e-3, maximum=1e6, read_only=False)
    max_angular_velocity: float = parameter(
        50.0, 'Rate of turn beyond which a velocity is refused (too_fast)',
        unit='rad/s', minimum=1e-3, maximum=1e6, read_only=False)
    on_time_jump: str = parameter(
        'reset', 'When the clock jumps, as in a looped recording: reset forgets the run, hold '
        'keeps pose and map', choices=('reset', 'hold'))
    angular_velocity_noise: Vector3 = parameter(
        (0.03, 0.03, 0.03), 'White noise of the angular velocity x y z: standard deviation of '
        'the angle after 1 s',
        unit='rad/√s', minimum=0.0, maximum=10.0, read_only=False, basic=True)
    linear_velocity_noise: Vector3 = parameter(
        (0.02, 0.02, 0.02), 'White noise of the linear velocity x y z: standard deviation of the '
        'distance after 1 s', unit='m/√s', minimum=0.0, maximum=100.0, read_only=False,
        basic=True)
    angular_scale_noise: Vector3 = parameter(
        (0.0, 0.0, 0.0), 'White noise of the angular velocity x y z in proportion to it, after 1 '
        's', unit='√s', minimum=0.0, maximum=10.0)
    linear_scale_noise: Vector3 = parameter(
        (0.0, 0.0, 0.0), 'White noise of the linear velocity x y z in proportion to it, after 1 '
        's', unit='√s', minimum=0.0, maximum=10.0)
    motion_noise_factor: str = parameter(
        'at_least_stated', "Riccati: whether the velocity's noise is as stated, as much more as "
        'what is seen shows (at_least_stated), or also less (auto)',
        choices=('stated', 'at_least_stated', 'auto'))
    unknown_angular_motion: float = parameter(
        0.5, 'How much the robot may turn while no velocity is known or wheels slip: standard '
        'deviation after 1 s', unit='rad/√s', minimum=0.0, maximum=100.0)
    unknown_linear_motion: float = parameter(
        0.5, 'How far the robot may go while no velocity is known or wheels slip: standard '
        'deviation after 1 s', unit='m/√s', minimum=0.0, maximum=1000.0)
    observation_model: str = parameter(
        'range_bearing', 'Which noise applies to landmarks whose message has no covariance',
        choices=('range_bearing', 'cartesian', 'stereo', 'fiducial'), basic=True)
    range_noise: float = parameter(
        0.1, 'Range and bearing: standard deviation of the range',
        unit='m', minimum=1e-4, maximum=1000.0, read_only=False, basic=True)
    range_scale_noise: float = parameter(
        0.0, 'Range and bearing: standard deviation of the range in proportion to it',
        minimum=0.0, maximum=10.0)
    bearing_noise: float = parameter(
        0.03, 'Range and bearing: standard deviation of each angle',
        unit='rad', minimum=1e-6, maximum=3.2, read_only=False, basic=True)
    point_noise: float = parameter(
        0.05, 'Cartesian: standard deviation of each coordinate',
        unit='m', minimum=1e-4, maximum=1000.0, read_only=False, basic=True)
    focal_length: float = parameter(
        500.0, 'Stereo and fiducial: focal length', unit='px', minimum=1.0, maximum=1e5)
    tag_size: float = parameter(
        0.16, 'Fiducial: edge of the square whose corners are detected',
        unit='m', minimum=1e-3, maximum=100.0)
    stereo_baseline: float = parameter(
        0.2, 'Stereo: baseline', unit='m', minimum=1e-3, maximum=1000.0)
    pixel_noise: float = parameter(
        1.0, 'Stereo: standard deviation across the line of sight; fiducial: of each corner',
        unit='px', minimum=1e-6, maximum=1e4, read_only=False)
    disparity_noise: float = parameter(
        1.0, 'Stereo: standard deviation of the disparity',
        unit='px', minimum=1e-6, maximum=1e4, read_only=False)
    use_tag_orientation: bool = parameter(
        False, "Riccati: whether a tag's orientation is used, too; then one tag in view gives "
        "the robot's heading", basic=True)
    orientation_noise: float = parameter(
        0.05, "Standard deviation of a tag's orientation about each axis, where its message has "
        'no covariance', unit='rad', minimum=1e-4, maximum=3.0, read_only=False)
    observation_correlation_time: float = parameter(
        0.0, "Riccati: correlation time of a landmark's observed error, as of a calibration, or "
        'of a tag seen from one side; 0 for independent errors',
        unit='s', minimum=0.0, maximum=60.0)
    angular_scale: Vector3 = parameter(
        (1.0, 1.0, 1.0), 'Factor of the angular velocity x y z, as for a track wider than the '
        'driver knows', minimum=0.1, maximum=10.0)
    linear_scale: Vector3 = parameter(
        (1.0, 1.0, 1.0), 'Factor of the linear velocity x y z, as for wheels larger than the '
        'driver knows', minimum=0.1, maximum=10.0)
    angular_bias: Vector3 = parameter(
        (0.0, 0.0, 0.0), 'Added to the angular velocity x y z after that, unless all of it is '
        'zero', unit='rad/s', minimum=-10.0, maximum=10.0)
    linear_bias: Vector3 = parameter(
        (0.0, 0.0, 0.0), 'Added to the linear velocity x y z after that, unless all of it is zero',
        unit='m/s', minimum=-100.0, maximum=100.0)
    velocity_delay: float = parameter(
        0.0, 'How much later than its stamp a velocity shows in observations; below zero if '
        'stamped late', unit='s', minimum=-MAX_DELAY_S, maximum=MAX_DELAY_S)
    angular_scale_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0), "Riccati: standard deviation of the angular velocity's scale x y z, "
        'which is estimated', minimum=0.0, maximum=1.0)
    linear_scale_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0), "Riccati: standard deviation of the linear velocity's scale x y z, "
        'which is estimated', minimum=0.0, maximum=1.0)
    angular_bias_stddev: Vector3 = parameter(
        (0.005, 0.005, 0.005), "Riccati: standard deviation of the angular velocity's bias x y "
        'z, which is estimated; the default suits a MEMS gyroscope, or wheels that differ by a '
        'few thousandths; 0 for none', unit='rad/s', minimum=0.0, maximum=10.0)
    linear_bias_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0), "Riccati: standard deviation of the linear velocity's bias x y z, which "
        'is estimated', unit='m/s', minimum=0.0, maximum=100.0)
    velocity_delay_stddev: float = parameter(
        0.2, 'Riccati: standard deviation of velocity_delay, which is estimated; 0 for none',
        unit='s', minimum=0.0, maximum=MAX_DELAY_S)
    sensor_rotation_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0), 'Riccati: how far each landmark sensor may be turned against /tf, about '
        'the body axes x y z, which is estimated; brackets are off by some 0.035 (2°)',
        unit='rad', minimum=0.0, maximum=1.0)
    sensor_translation_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0), 'Riccati: how far each landmark sensor may be shifted against /tf, '
        'along the body axes x y z, which is estimated',
        unit='m', minimum=0.0, maximum=10.0)
    range_scale: float = parameter(
        1.0, "Factor of a sensor's ranges, as for tags larger than the detector knows, or a "
        'wrong focal length', minimum=0.1, maximum=10.0)
    range_scale_stddev: float = parameter(
        0.0, 'Riccati: standard deviation of range_scale, which is estimated; without a surveyed '
        "map it can hardly be distinguished from the velocity's scale",
        minimum=0.0, maximum=1.0)
    range_bias_stddev: float = parameter(
        0.0, 'Riccati: how much too long all ranges from one landmark may be, which is estimated '
        'for each of them, of ranges without a direction in space: delays of UWB antennas are off '
        'by some 0.1', unit='m', minimum=0.0, maximum=10.0)
    range_is_depth: bool = parameter(
        False, "Whether the sensor's range is depth along its axis, as of cameras that judge "
        'distance by apparent size; the axis is x of its frame, z of an optical one')
    calibration_drift: float = parameter(
        0.0, 'Riccati: how fast the calibration of velocity and sensors drifts, as a share of '
        'each standard deviation', unit='1/√s', minimum=0.0, maximum=10.0)
    landmark_velocity_stddev: float = parameter(
        0.0, 'Riccati: spread of constant landmark velocities, which are estimated; 0: landmarks '
        'are static', unit='m/s', minimum=0.0, maximum=100.0)
    huber_threshold: float = parameter(
        1.345, 'Riccati: standard deviations beyond which an observation loses weight; 0 for '
        'never', minimum=0.0, maximum=1e9, read_only=False)
    rejection_threshold: float = parameter(
        6.0, 'Riccati: standard deviations of the residual beyond which an observation is '
        'rejected', unit='σ', minimum=1.0, maximum=1e9, read_only=False)
    confirmations: int = parameter(
        3, 'Observations after which a landmark is in the map', minimum=1, maximum=1_000_000)
    max_rejections: int = parameter(
        5, 'Riccati: rejections in a row, all at one position, after which a landmark has moved; '
        'one more than it was seen, if fewer', minimum=1, maximum=1_000_000)
    max_landmarks: int = parameter(
        2000, 'Most landmarks kept; a new one then replaces the one seen least often; 0 for any '
        'number', minimum=0, maximum=1_000_000)
    max_points: int = parameter(
        100, 'Riccati: most points of an observation that are used, known landmarks first, then '
        'the nearest in each direction; time grows with the cube of their number',
        minimum=1, maximum=1_000_000)
    max_hypotheses: int = parameter(
        8, 'Riccati, points without id, or a robot that may have slipped: most hypotheses that '
        'are followed', minimum=1, maximum=1000)
    relinearization_interval: int = parameter(
        20, 'Riccati: fewest new observations before relinearising; a tenth of all so far if '
        'that is more, at most 300; 0 for never', minimum=0, maximum=1_000_000_000)
    relinearization_angle: float = parameter(
        0.2, 'Riccati: relinearise once attitude corrections reach this as a root sum square; '
        'after a single one of this size a tenth of the interval is enough',
        unit='rad', minimum=0.0, maximum=1e9)
    smoothing_window: int = parameter(
        3000, 'Riccati: most observations smoothed together; the next ones go on from there; 0 '
        'for all, the default of replay --smooth', minimum=0, maximum=1_000_000_000)
    localization_mode: str = parameter(
        'off', 'What a loaded map is: off, a start from which mapping goes on; uncertain, '
        'refined within its covariance (constant gains know none), without new landmarks; fixed, '
        'exact and at rest', choices=('off', 'uncertain', 'fixed'), basic=True)
    set_initial_pose: bool = parameter(
        False, 'Whether the robot starts at initial_pose: exactly, or in a loaded map within '
        '0.5 m and 0.26 rad, instead of localising by landmarks')
    initial_pose: Pose6 = parameter(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 'Where the robot starts, x y z and roll pitch yaw, with '
        'set_initial_pose', unit='m, rad', minimum=-MAX_POSITION_M, maximum=MAX_POSITION_M)
    map_noise: float = parameter(
        0.05, 'Standard deviation of each coordinate of loaded landmarks whose file gives none',
        unit='m', minimum=0.0, maximum=1000.0)
    # fmt: on
    # What scripts of snapshots before 0.1.0 state in place of initial_pose; no parameters.
    initial_position: InitVar[Vector3 | None] = None
    initial_yaw: InitVar[float | None] = None

    def __post_init__(self, initial_position: Vector3 | None, initial_yaw: float | None) -> None:
        """Take a pose at the start that is stated in parts."""
        if initial_position is None and initial_yaw is None:
            return
        x, y, z = initial_position or self.initial_pose[:3]
        roll, pitch, yaw = self.initial_pose[3:]
        yaw = yaw if initial_yaw is None else initial_yaw
        object.__setattr__(self, 'initial_pose', (x, y, z, roll, pitch, yaw))


class LiveSettings(Settings):
    """The settings in force, which change while a node runs: all that hold them see that."""

    @classmethod
    def of(cls, settings: Settings) -> LiveSettings:
        """Return such a copy."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(settings)})

    def follow(self, settings: Settings) -> None:
        """Take over the values of other settings."""
        for field in fields(self):
            object.__setattr__(self, field.name, getattr(settings, field.name))
