"""The estimator's settings: one table for the node, YAML files, the command line and docs."""

from __future__ import annotations

from dataclasses import dataclass, fields

from slam_observer_ros.settings.parameter_table import parameter

Vector3 = tuple[float, float, float]


MAX_DELAY_S = 1.0
"""Delay of velocities that is made up for at most."""

MAX_POSITION_M = 1e7
"""Coordinate of a given pose at most: a map's origin may be UTM's."""


@dataclass(frozen=True)
class Settings:
    """Settings of the estimator; each field is a parameter."""

    gains: str = parameter(
        'riccati',
        'What sets the gains: two numbers (constant) or the covariance of all errors (riccati)',
        choices=('constant', 'riccati'),
        basic=True,
    )
    two_d_mode: bool = parameter(
        False, 'Whether motion and map are planar: z, roll and pitch stay exactly zero', basic=True
    )
    gain_k: float = parameter(
        4.0,
        "Constant gains: k of the paper's (30), with metres: how fast the pose follows the "
        'residuals',
        unit='1/s',
        minimum=1e-6,
        maximum=1e6,
        read_only=False,
    )
    gain_l: float = parameter(
        1.0,
        "Constant gains: l of the paper's (31); a landmark's residual decays at the rate l/k",
        unit='1/s²',
        minimum=0.0,
        maximum=1e6,
        read_only=False,
    )
    step_mode: str = parameter(
        'exponential',
        "Constant gains: discrete step; 'paper' converges to the paper's equation for small steps",
        choices=('exponential', 'paper'),
        read_only=False,
    )
    max_innovation_time: float = parameter(
        0.2,
        'Constant gains: an observation acts for the time since its landmark was last seen, at '
        'most this long',
        unit='s',
        minimum=1e-3,
        maximum=3600.0,
        read_only=False,
    )
    velocity_timeout: float = parameter(
        1.0,
        'How long a velocity is held; after that the pose is held and flagged as stale',
        unit='s',
        minimum=1e-3,
        maximum=3600.0,
    )
    reorder_window: float = parameter(
        0.05,
        'How long events are held back to be put in stamp order, at most: after the first 10 s '
        'twice as long as any was late in the last 10 s',
        unit='s',
        minimum=0.0,
        maximum=10.0,
        basic=True,
    )
    late_limit: float = parameter(
        2.0,
        'How late an event may come after the reorder window: an observation is carried forward, '
        'a velocity counts from then on, unless a newer one of its kind was used before it',
        unit='s',
        minimum=0.0,
        maximum=60.0,
    )
    max_stamp_jump: float = parameter(
        10.0,
        'A stamp further ahead of all others than this is refused until others confirm it',
        unit='s',
        minimum=0.1,
        maximum=1e9,
    )
    max_linear_velocity: float = parameter(
        100.0,
        'Greatest speed that a message is believed: beyond it the velocity is refused (too_fast)',
        unit='m/s',
        minimum=1e-3,
        maximum=1e6,
        read_only=False,
    )
    max_angular_velocity: float = parameter(
        50.0,
        'Greatest rate of turn that a message is believed: beyond it the velocity is refused '
        '(too_fast)',
        unit='rad/s',
        minimum=1e-3,
        maximum=1e6,
        read_only=False,
    )
    on_time_jump: str = parameter(
        'reset',
        'What happens when the clock jumps, as in a recording that is looped: reset forgets the '
        'run, hold keeps pose and map',
        choices=('reset', 'hold'),
    )
    angular_velocity_noise: Vector3 = parameter(
        (0.03, 0.03, 0.03),
        'White noise of the angular velocity x y z: standard deviation of the angle after 1 s',
        unit='rad/√s',
        minimum=0.0,
        maximum=10.0,
        read_only=False,
        basic=True,
    )
    linear_velocity_noise: Vector3 = parameter(
        (0.02, 0.02, 0.02),
        'White noise of the linear velocity x y z: standard deviation of the distance after 1 s',
        unit='m/√s',
        minimum=0.0,
        maximum=100.0,
        read_only=False,
        basic=True,
    )
    angular_scale_noise: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'White noise of the angular velocity x y z in proportion to it, after 1 s',
        unit='√s',
        minimum=0.0,
        maximum=10.0,
    )
    linear_scale_noise: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'White noise of the linear velocity x y z in proportion to it, after 1 s',
        unit='√s',
        minimum=0.0,
        maximum=10.0,
    )
    motion_noise_factor: str = parameter(
        'at_least_stated',
        'Riccati gains: whether the noise of the velocity is as stated, as much more as what is '
        'seen shows (at_least_stated), or also less (auto)',
        choices=('stated', 'at_least_stated', 'auto'),
    )
    unknown_angular_motion: float = parameter(
        0.5,
        'How much the robot may turn while no velocity is known, or its wheels slip: standard '
        'deviation after 1 s',
        unit='rad/√s',
        minimum=0.0,
        maximum=100.0,
    )
    unknown_linear_motion: float = parameter(
        0.5,
        'How far the robot may go while no velocity is known, or its wheels slip: standard '
        'deviation after 1 s',
        unit='m/√s',
        minimum=0.0,
        maximum=1000.0,
    )
    observation_model: str = parameter(
        'range_bearing',
        'Which noise figures apply to landmarks whose message has no covariance',
        choices=('range_bearing', 'cartesian', 'stereo', 'fiducial'),
        basic=True,
    )
    range_noise: float = parameter(
        0.1,
        'Range and bearing: standard deviation of the range',
        unit='m',
        minimum=1e-4,
        maximum=1000.0,
        read_only=False,
        basic=True,
    )
    range_scale_noise: float = parameter(
        0.0,
        'Range and bearing: part of the standard deviation of the range in proportion to it',
        minimum=0.0,
        maximum=10.0,
    )
    bearing_noise: float = parameter(
        0.03,
        'Range and bearing: standard deviation of each angle',
        unit='rad',
        minimum=1e-6,
        maximum=3.2,
        read_only=False,
        basic=True,
    )
    point_noise: float = parameter(
        0.05,
        'Cartesian: standard deviation of each coordinate',
        unit='m',
        minimum=1e-4,
        maximum=1000.0,
        read_only=False,
        basic=True,
    )
    focal_length: float = parameter(
        500.0, 'Stereo and fiducial: focal length', unit='px', minimum=1.0, maximum=1e5
    )
    tag_size: float = parameter(
        0.16,
        'Fiducial: edge of the square whose corners are detected',
        unit='m',
        minimum=1e-3,
        maximum=100.0,
    )
    stereo_baseline: float = parameter(
        0.2, 'Stereo: baseline', unit='m', minimum=1e-3, maximum=1000.0
    )
    pixel_noise: float = parameter(
        1.0,
        'Stereo: standard deviation across the line of sight; fiducial: of each corner',
        unit='px',
        minimum=1e-6,
        maximum=1e4,
        read_only=False,
    )
    disparity_noise: float = parameter(
        1.0,
        'Stereo: standard deviation of the disparity',
        unit='px',
        minimum=1e-6,
        maximum=1e4,
        read_only=False,
    )
    use_tag_orientation: bool = parameter(
        False,
        'Riccati gains: whether the orientation of a tag is used, not its position alone; then '
        "one tag in view determines the robot's heading",
        basic=True,
    )
    orientation_noise: float = parameter(
        0.05,
        "Standard deviation of a tag's orientation about each axis, where its message has no "
        'covariance',
        unit='rad',
        minimum=1e-4,
        maximum=3.0,
        read_only=False,
    )
    observation_correlation_time: float = parameter(
        0.0,
        'Riccati gains: correlation time of the error of an observed landmark, such '
        'as that of a calibration, or of a tag seen from one side; 0 for errors that are '
        'independent in each observation',
        unit='s',
        minimum=0.0,
        maximum=60.0,
    )
    angular_scale: Vector3 = parameter(
        (1.0, 1.0, 1.0),
        'What the angular velocity x y z is multiplied by, as for a track that is wider than the '
        'driver knows',
        minimum=0.1,
        maximum=10.0,
    )
    linear_scale: Vector3 = parameter(
        (1.0, 1.0, 1.0),
        'What the linear velocity x y z is multiplied by, as for wheels that are larger than the '
        'driver knows',
        minimum=0.1,
        maximum=10.0,
    )
    angular_bias: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'What is added to the angular velocity x y z after that, unless all of it is zero',
        unit='rad/s',
        minimum=-10.0,
        maximum=10.0,
    )
    linear_bias: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'What is added to the linear velocity x y z after that, unless all of it is zero',
        unit='m/s',
        minimum=-100.0,
        maximum=100.0,
    )
    velocity_delay: float = parameter(
        0.0,
        'How much later than its stamp a velocity shows in observations; below zero where it is '
        'stamped late',
        unit='s',
        minimum=-MAX_DELAY_S,
        maximum=MAX_DELAY_S,
    )
    angular_scale_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'Riccati gains: scale error of the angular velocity x y z to be estimated: '
        'its standard deviation',
        minimum=0.0,
        maximum=1.0,
    )
    linear_scale_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'Riccati gains: scale error of the linear velocity x y z to be estimated: '
        'its standard deviation',
        minimum=0.0,
        maximum=1.0,
    )
    angular_bias_stddev: Vector3 = parameter(
        (0.005, 0.005, 0.005),
        'Riccati gains: bias of the angular velocity x y z to be estimated: its '
        "standard deviation; the default is that of a MEMS gyroscope's zero, or of wheels that "
        'differ by a few thousandths; 0 for none',
        unit='rad/s',
        minimum=0.0,
        maximum=10.0,
    )
    linear_bias_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'Riccati gains: bias of the linear velocity x y z to be estimated: its standard deviation',
        unit='m/s',
        minimum=0.0,
        maximum=100.0,
    )
    velocity_delay_stddev: float = parameter(
        0.2,
        'Riccati gains: delay from the stamp of a velocity to its effect in '
        'observations, to be estimated: its standard deviation; 0 for none',
        unit='s',
        minimum=0.0,
        maximum=MAX_DELAY_S,
    )
    sensor_rotation_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'Riccati gains: how far a sensor of landmarks may be turned against what /tf says, about '
        'the body axes x y z, to be estimated for each sensor frame: its standard deviation; '
        'brackets are turned by some 0.035 (2°)',
        unit='rad',
        minimum=0.0,
        maximum=1.0,
    )
    sensor_translation_stddev: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'Riccati gains: how far a sensor of landmarks may be from where /tf says, along the body '
        'axes x y z, to be estimated: its standard deviation',
        unit='m',
        minimum=0.0,
        maximum=10.0,
    )
    range_scale: float = parameter(
        1.0,
        "What a sensor's ranges are multiplied by, as for tags printed larger than the detector "
        'knows, or a focal length that is off',
        minimum=0.1,
        maximum=10.0,
    )
    range_scale_stddev: float = parameter(
        0.0,
        'Riccati gains: how far range_scale may be off, to be estimated: its standard deviation; '
        'without a surveyed map it can hardly be distinguished from the scale of velocities',
        minimum=0.0,
        maximum=1.0,
    )
    range_is_depth: bool = parameter(
        False,
        'Whether the sensor takes for range what is depth along its axis, as cameras do that '
        "judge distance by apparent size; the axis is x of the sensor's frame, z of an optical "
        'one',
    )
    calibration_drift: float = parameter(
        0.0,
        'Riccati gains: how fast the calibration of velocity and sensors drifts, as '
        'a share of the standard deviation of each part',
        unit='1/√s',
        minimum=0.0,
        maximum=10.0,
    )
    landmark_velocity_stddev: float = parameter(
        0.0,
        'Riccati gains: spread of unknown constant landmark velocities to be estimated; 0: static',
        unit='m/s',
        minimum=0.0,
        maximum=100.0,
    )
    huber_threshold: float = parameter(
        1.345,
        'Riccati gains: standard deviations of noise beyond which an observation '
        'loses weight; 0 for never',
        minimum=0.0,
        maximum=1e9,
        read_only=False,
    )
    rejection_threshold: float = parameter(
        6.0,
        'Riccati gains: standard deviations of the residual beyond which an '
        'observation is rejected',
        unit='σ',
        minimum=1.0,
        maximum=1e9,
        read_only=False,
    )
    confirmations: int = parameter(
        3,
        'Observations after which a landmark is in the map',
        minimum=1,
        maximum=1_000_000,
    )
    max_rejections: int = parameter(
        5,
        'Riccati gains: rejections in a row, all at one position, after which a '
        'landmark is taken to have moved; one more than it was seen, if that is fewer',
        minimum=1,
        maximum=1_000_000,
    )
    max_landmarks: int = parameter(
        2000,
        'Most landmarks kept; a new one then replaces the one seen least often; 0 for any number',
        minimum=0,
        maximum=1_000_000,
    )
    max_points: int = parameter(
        100,
        'Riccati gains: most points of one observation that are used, those of known landmarks '
        'first, then the nearest in each direction; time grows with the cube of their number',
        minimum=1,
        maximum=1_000_000,
    )
    min_support: int = parameter(
        5,
        'Riccati gains, points without id: how often a landmark must be seen to be in the map; it '
        'is deleted if still not after four times as long in view as a typical one needs',
        minimum=1,
        maximum=1_000_000,
    )
    max_hypotheses: int = parameter(
        8,
        'Riccati gains, points without id, or a robot that may have slipped: most hypotheses that '
        'are followed until it is clear which one is right; where points have no id, no more than '
        'two',
        minimum=1,
        maximum=1000,
    )
    relinearization_interval: int = parameter(
        20,
        'Riccati gains: fewest new observations before relinearising; a tenth of all so far if '
        'that is more, but at most 300; 0 for never',
        minimum=0,
        maximum=1_000_000_000,
    )
    relinearization_angle: float = parameter(
        0.2,
        'Riccati gains: relinearise once attitude corrections have reached this as a root sum '
        'square; after a single one of this size a tenth of the interval is enough',
        unit='rad',
        minimum=0.0,
        maximum=1e9,
    )
    smoothing_window: int = parameter(
        3000,
        'Riccati gains: most observations that are smoothed together; the next ones go on from '
        'the estimate then; 0 for all together, the default of replay --smooth',
        minimum=0,
        maximum=1_000_000_000,
    )
    localization_mode: str = parameter(
        'off',
        'What a loaded map is: off, a start from which mapping goes on; uncertain, landmarks that '
        'are refined within their covariance (constant gains know none), with no new ones added; '
        'fixed, exact and at rest',
        choices=('off', 'uncertain', 'fixed'),
        basic=True,
    )
    localization_error_probability: float = parameter(
        1e-3,
        'Riccati gains, points without id in a loaded map: how likely the place where they fit '
        'may be wrong',
        minimum=1e-9,
        maximum=0.1,
    )
    set_initial_pose: bool = parameter(
        False,
        'Whether the robot starts at initial_position and initial_yaw: exactly, or in a loaded '
        'map within initial_position_stddev and initial_angle_stddev, instead of localising there '
        'by landmarks',
    )
    initial_position: Vector3 = parameter(
        (0.0, 0.0, 0.0),
        'Where the robot starts, x y z, with set_initial_pose',
        unit='m',
        minimum=-MAX_POSITION_M,
        maximum=MAX_POSITION_M,
    )
    initial_yaw: float = parameter(
        0.0,
        'How the robot is turned at the start, with set_initial_pose',
        unit='rad',
        minimum=-6.3,
        maximum=6.3,
    )
    initial_roll: float = parameter(
        0.0,
        'Its roll then, where it does not stand upright',
        unit='rad',
        minimum=-6.3,
        maximum=6.3,
    )
    initial_pitch: float = parameter(
        0.0,
        'Its pitch then',
        unit='rad',
        minimum=-6.3,
        maximum=6.3,
    )
    initial_position_stddev: float = parameter(
        0.5,
        'In a loaded map: standard deviation of each coordinate of initial_position',
        unit='m',
        minimum=0.0,
        maximum=1000.0,
    )
    initial_angle_stddev: float = parameter(
        0.26,
        'In a loaded map: standard deviation of how the robot is turned, about each axis',
        unit='rad',
        minimum=0.0,
        maximum=3.2,
    )
    map_noise: float = parameter(
        0.05,
        'Standard deviation of each coordinate of loaded landmarks whose file gives none',
        unit='m',
        minimum=0.0,
        maximum=1000.0,
    )


class LiveSettings(Settings):
    """The settings in force: a copy that follows changes, as some change while a node runs.

    All that hold it see them, and copies share it.
    """

    @classmethod
    def of(cls, settings: Settings) -> LiveSettings:
        """Return such a copy."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(settings)})

    def follow(self, settings: Settings) -> None:
        """Take over the values of other settings."""
        for field in fields(self):
            object.__setattr__(self, field.name, getattr(settings, field.name))
