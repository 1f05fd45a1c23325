"""What may be wrong, in words: the only place that has them, for table, JSON, report, log and ROS.

``runs/health.py`` judges what is; the estimator's log has what happens on the way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import IntEnum
import logging
import threading


class Level(IntEnum):
    """How bad it is; the numbers are as in diagnostic_msgs/DiagnosticStatus."""

    NOTE = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is, or may be, wrong: what, how bad, since when, and what to do.

    It is of the time from ``start_s`` to ``end_s``, seconds since the run's first event; None
    where it is of the whole run, or goes on.
    """

    kind: str
    level: Level
    what: str
    remedy: str
    start_s: float | None = None
    end_s: float | None = None

    def __str__(self) -> str:
        return self.text()

    def text(self, note: str = '') -> str:
        """Return it as a sentence, with a note behind what is wrong."""
        what = self.what
        if not KINDS[self.kind].what.startswith('{'):  # with a name as it is
            what = what[:1].upper() + what[1:]
        joint = '; ' if ': ' in what else ': '
        end = '' if self.remedy.endswith(('?', '.')) else '.'
        return f'{what}{note}{joint}{self.remedy}{end}'

    def as_json(self) -> dict[str, object]:
        """Return its parts as ``--json`` has them."""
        return asdict(self) | {'level': self.level.name.lower()}


NOISE = 'state more noise (Tune the noise)'
POSE_DIFFERENCES = 'set velocity_source: pose_differences (in replay --velocity-source)'
GIVE_THE_POSE = 'drive on, or give the pose (on initialpose, or by set_initial_pose)'
INPUTS = (
    'look at the signs, units and frames of the velocity and of the points, then at their noise, '
    'and in a loaded map whether that is still true'
)

_TEXTS = {
    # What of the inputs was used
    'nothing_used':
        'nothing was used, neither a velocity nor an observation (dropped: {dropped}) '
        '→ see why it was dropped (Troubleshooting)',
    'no_velocity': 'no velocity was used (dropped: {dropped}): the landmarks alone move the robot '
        '→ see why they were dropped (Troubleshooting)',
    'no_observation': 'no observation was used (dropped: {dropped}): the velocities alone gave '
        'the trajectory → see why they were dropped (Troubleshooting)',
    'no_angular_velocity': 'no angular velocity of {topic} was used (dropped: {dropped}): the one '
        'of {instead} was taken → see why they were dropped (Troubleshooting)',
    'unused_input': "none of {count} messages on '{topic}' was used → see why they are dropped, "
        'in the values of this status and in the log',
    'dropped_messages': '{count} dropped ({reasons}) → see what the reasons mean '
        '(Troubleshooting), and whose messages they are in the log',
    'paused': 'paused → resume it by the service that has paused it',
    'silent_input': "no message on '{topic}' → see whether its driver has stopped",
    'several_types': "two types are published on '{topic}', of which one can be heard at a time: "
        '{heard} is heard, and {others} is not → let all publish one type, remap the others, or '
        'choose one by velocity_type or landmarks_type',
    'several_publishers': "{count} publishers ({names}) publish on '{topic}' → remap all but one",
    'empty_messages': 'no landmark in {count} messages so far → are there any in view, and is the '
        'detector set up for them?',
    # Mistakes of the set-up (runs/mistakes.py)
    'points_in_optical_axes': "the points are in a camera's axes, z forward, and their frame has "
        "a robot's, x forward → give the sensor an optical frame in /tf, or end sensor_pose by "
        '-1.5708, 0.0, -1.5708',
    'points_mirrored': 'the y of the points is negated: left and right are exchanged → see what '
        'the detector publishes, or whether it is turning that is negated',
    'points_backwards': 'the sensor looks backwards: it is mounted turned by 180° about z → state '
        'so in /tf, or end sensor_pose by 0.0, 0.0, 3.1416, or see whether it is the speed that '
        'is negated',
    'points_in_millimetres': 'the points are in millimetres → let the detector publish metres '
        '(REP 103)',
    'tag_size': 'by {by} ranges are {factor:.2f} times as long as they are measured: the size of '
        'the tags is stated wrong by that factor, or what else gives the distance (a map decides '
        "whether the radius of the wheels does) → see which: measure a tag's edge, or drive a "
        'metre',
    'turning_in_degrees': 'the angular velocity is in degrees → let the driver publish rad/s (REP '
        '103)',
    'speed_in_kmh': 'the speed is in km/h → let the driver publish m/s (REP 103)',
    'turning_negated': 'the angular velocity is negated: to the left is positive (REP 103) → see '
        'the signs of the driver, or whether it is the y of the points that is negated',
    'driving_negated': 'the speed is negated: forward is positive (REP 103) → see the signs of '
        'the driver, or whether it is the sensor that looks backwards',
    'no_turning': 'the angular velocity is always zero, but the robot turns → see whether the '
        'driver fills it in, or set use_imu for the one of an IMU',
    'mount_off': '{sensor} looks mounted {off} {towards} than /tf says → set '
        'sensor_rotation_stddev to how far that may be off, or calibrate (Calibrate a sensor)',
    # Times of the inputs
    'silence': 'no {input} on {topic} for {silence_s:.1f} s of {duration_s:.1f} s '
        '(velocity_timeout): {consequence} → see whether its driver stopped, or messages were '
        'lost on the way',
    'landmarks_end': 'no landmarks on {topic} for the last {silence_s:.1f} s of {duration_s:.1f} '
        's → did the detector end?',
    'early_stamps': "stamps of {topic} are {ahead_s:.1f} s ahead of the recorder's clock → "
        'synchronise the clocks',
    'other_clock': 'stamps of {topic} are {offset_s:.1f} s {side} the stamps of {other}, by when '
        'both were received → synchronise the clocks; a node with correct_clock_offset takes this '
        'recording, played with --clock, as it is',
    'stamps_of_1970': 'stamps of {topics} are of 1970: they count from the start of a driver or '
        'machine, or are of a simulation → let it stamp with the time of ROS, or record all with '
        'use_sim_time; a node with correct_clock_offset takes this recording, played with '
        '--clock, as it is',
    'zero_stamps': 'stamps are zero on {topics}; {count} messages have the time of their '
        'reception instead → let their publishers fill in header.stamp',
    'clock_jumped': 'trajectory, map, errors and figures are only of the {seconds:.1f} s after '
        'the last jump of the clock ({count} in all) → record with one clock, or set '
        'on_time_jump: hold',
    # The recording
    'damaged': '{path}: damaged; {loss} → record it again if what is lost matters; --strict '
        'refuses such recordings',
    'incomplete_recording': '{problem} → record it again if what is lost matters; --strict '
        'refuses such recordings',
    'malformed_message': 'malformed message on {topic}: {error} → see whether all of them are, by '
        'the count of these (Troubleshooting)',
    'several_robots': 'no transforms are used: those on {topics} are of several robots, and none '
        'of them is in the namespace that {inputs} share → only replay topics of one namespace, '
        'or set sensor_pose',
    'guessed_base': "the velocities don't say whose they are: '{frame}', the landmarks' frame, is "
        'taken for the robot → set another by --base-frame',
    'unread_truth': 'named like ground truth, but not of a type that true poses are read of '
        '({types}): {topics} → record it as one of these, or do without',
    'truth_frame': "the true poses are of '{frame}', and the estimated ones of '{base_frame}': "
        'they are compared as if that were one frame ({error}) → record the transform between '
        'them, or set --base-frame',
    'uncompared': 'the {figure} is not compared with the truth: {error} → see whether truth and '
        'estimate are of the same time and place',
    'unknown_anees': 'the ANEES is not known: {error} → record the truth from the start on',
    # Transforms
    'unused_transform': "a transform on /tf of frame '{frame}' is not used: {reason} → see what "
        'publishes it; the other transforms of the message are used',
    'velocity_frame': "velocities in frame '{frame}' are taken as if in '{base_frame}' until "
        'their transform is known: {error} → let /tf or /tf_static have it',
    'zero_twist': 'all velocities on {topic} are zero, but its poses move → ' + POSE_DIFFERENCES,
    'wrong_twist': 'the twist on {topic} {problem} → ' + POSE_DIFFERENCES,
    # The velocity, its calibration and noise
    'stale_velocity': 'no velocity in force: the pose is held → see whether its driver has '
        'stopped, or velocity_timeout is too short for it',
    'rare_velocity': 'a velocity comes only each {period_s:.1f} s, as commands by key press do: '
        'how the robot moves meanwhile is not known, nor what delay and noise the velocities have '
        "→ use the wheels' odometry, or let commands be repeated ten times a second",
    'late_odometry': 'the odometry takes effect {delay_s:.2f} s {when} → mind it in the driver, '
        'or set velocity_delay: {set_to:.2f} (Tune the noise)',
    'implausible_calibration': '{name} is {value:.3g}, {times:.0f} times its stated error '
        '({stated:.3g}) from {nominal} → are signs, units and frames of velocity and points '
        'right?',
    'mounting': '{sensor} is mounted {off} {towards} than /tf says → add {amount:.4f} to {entry} '
        'of its transform or sensor_pose',
    'range_scale': 'ranges of {sensor} are to be multiplied by {found} → set range_scale: '
        '{value:.4f}',
    'depth_for_range': 'the range looks like {looks}: off the axis it grows with the cosine to '
        'the power of {power:.2f} ± {deviation:.2f} → set range_is_depth: {set_to}, or run '
        'slam-observer calibrate (Calibrate a sensor)',
    'noisy_odometry': 'the odometry is {factor:.1f} × noisier in {motion} than stated → '
        '{proposed}, or let its messages state larger covariances',
    'axis_noise': '{turn_or_way}_velocity_noise and {turn_or_way}_scale_noise of {axis} explain '
        '{ratio} × less than what is seen of measured {motion} against the truth → state more '
        '(Tune the noise)',
    'motion_noise': 'after {gap_s:g} s without landmarks the noise explains {ratio} × less than '
        'what is seen → state more noise of the velocity (Tune the noise)',
    # The points
    'rejected_points': '{percent:.0f} % of the points {when}were rejected → ' + INPUTS,
    'rejected_orientations': 'the orientations of {percent:.0f} % of the tags {when}were rejected '
        '→ has the map other tag axes than the detector (slam-observer map convert --tag-axes)?',
    'unmapped_points': '{percent:.0f} % of the points are of no landmark of the map → is it the '
        'map of this place{start}?',
    'left_out_points': 'of {count} points seen {reasons} → {remedy}',
    'point_noise': 'while landmarks are seen the noise explains {ratio} × less than what is seen '
        '→ state more noise of the points (Tune the noise)',
    'small_noise': 'the stated noise is too small by a factor of {factor:.1f} → state more noise '
        'of the points or of the velocity (Tune the noise)',
    'large_noise': 'the stated noise is too large by a factor of {factor:.1f} → state less noise '
        'of the points or of the velocity (Tune the noise)',
    # The pose
    'error_growth': 'the position error grew from {before_m:.2g} to {after_m:.2g} m at '
        '{start_s:.0f} to {end_s:.0f} s: {circumstances} → look at the map and the curves at that '
        'time',
    'overconfident_pose': 'the errors of the pose are {factor:.1f} × as large as its covariance '
        'states (ANEES {anees:.1f}) → ' + NOISE,
    'unknown_pose': 'the pose in the loaded map is not known yet: no pose is published → '
        '' + GIVE_THE_POSE,
    'no_place': 'what was seen fits no place in {where} yet → ' + GIVE_THE_POSE,
    'other_hall': '{count} landmarks are seen whose ids the map has, and they lie to each other '
        'otherwise than there → load the map of this place, or map it again if they were moved',
    'other_ids': '{count} landmarks lie to each other as in the map{name}, which has other ids '
        'there → see whether it is the map of a place built alike, or the ids were changed since',
    'ambiguous_place': 'what was seen fits {number} in {where}, {places} → ' + GIVE_THE_POSE,
    'anchor_biased': 'ranges from landmark {anchor} are {off_m:.2f} m too {towards} wherever they '
        "are measured → survey that anchor again, and calibrate its antenna's delay",
    'side_undecided': 'the views of landmarks {ids} fit two places each, one on either side of '
        'the way → drive a curve',
    'drive_a_curve': 'the ranges or directions seen so far fit {number} places in {where}, '
        '{places} → drive a curve, or give the pose (on initialpose, or by set_initial_pose)',
    'anchors_in_a_line': 'the landmarks seen so far ({ids}) stand in a line, and their ranges fit '
        'on both sides of it → move one of them off the line, drive on to others, or give the '
        'pose (on initialpose, or by set_initial_pose)',
    'lost_pose': 'the pose in the map {path} was lost after {seconds:.1f} s, and not found again: '
        'the trajectory ends there → see what was rejected then; was the robot carried out of the '
        'map?',
    'slip': 'odometry does not explain what is seen: the robot slipped or was carried, or the '
        'stated noise of its velocity is too small → if it did not, state more noise of the '
        'velocity (Tune the noise)',
    'unexpected_place': 'nothing that is seen is where the map has it: if the robot was carried '
        'to where it knows nothing, without ids it is found again in a loaded map only → give its '
        'pose on initialpose, or start again',
    'doubled_landmark': 'a landmark without an id was added where a known one should be seen and '
        'is not: that one was moved, or it is in the map twice now → if it was not moved, state '
        'more noise of the velocity or of the points (Tune the noise)',
    'ambiguous_map': 'what is seen without ids fits several maps for {lasts_s:.0f} s, from '
        '({x:.1f} m, {y:.1f} m) on: the one that is shown is right with a probability of '
        '{probability:.2f}, and others differ in landmarks {ids} → drive to where more known '
        'landmarks are in view, or give some of them ids',
    'unconfirmed_map': '{waiting} landmarks without ids were seen too seldom to be sure that they '
        'exist, and only {known} are in the map → drive more slowly, or see them more often',
    'wrong_pose': 'the pose in the map is wrong: {reason}; localising again → ' + GIVE_THE_POSE,
    'contradicted_pose': 'the pose in the map is wrong, or the landmarks in view were moved: they '
        'contradict it → drive to where more of the map is in view, or give the pose (on '
        'initialpose)',
    'diverged': 'the estimate has diverged: the pose is {distance_m:.1e} m from its origin; it '
        'starts again → look at the noise of velocities and landmarks: it may be set orders of '
        'magnitude wrong',
    'clock_reset': 'the clock has jumped{way}: starting again → set on_time_jump: hold to keep '
        'pose and map',
    'clock_held': 'the clock has jumped{way}: pose and map are held → look for a wrong clock if '
        'no recording was started again',
    'not_relinearised': 'could not relinearise (said only once): the observations so far leave '
        'something open, as where covariances are so large that they say nothing; odometry often '
        'has such for z, roll and pitch → set two_d_mode: true for a robot on a floor',
    # Settings
    'ignored_settings': 'no effect on {gains} gains: {names} → do without them, or use other '
        'gains',
    'ignored_orientations': 'no effect of use_tag_orientation with landmark_velocity_stddev: '
        'landmarks are points that move → set landmark_velocity_stddev: 0.0 for tags at rest',
    'ignored_start': 'no effect of initial_pose → use set_initial_pose: true',
    # A loaded map
    'left_out_of_table': '{path}: left out: {columns} → see whether the map needs any of it',
    'flat_map': 'the map was made with two_d_mode, which is off: in space its heights of zero are '
        'taken for exact → use two_d_mode: true for a robot on a floor',
    'skipped_file': '{name} of the folder of maps is skipped, as it {why} → keep other files '
        'elsewhere',
    'equal_maps': 'the maps {other} and {name} say the same, so {other} is used for both → keep '
        'one of the two in the folder',
    'alike_maps': 'of the maps {other} and {name}, {count} landmarks are the same{moved}: a robot '
        'that sees only these fits in both → take one of the two out of the folder, or, if they '
        'are two places, give each ids that the other one has not',
    'symmetric_map': 'the map{name} is the same turned by {turn_deg:.0f}°{but}: without ids or a '
        'start pose the robot {consequence} → add one more landmark: at ({x:.1f} m, {y:.1f} m) it '
        'would do',
    # Events, as they come; the log has how many of each
    'dropped_message': 'dropped a message, {reason}: {error} → see Troubleshooting for the reason',
    'late_velocity': 'a velocity came later than reorder_window allows and counts only from then '
        'on → set reorder_window larger if this is frequent',
    'repeated_id': 'not used: an observation has several points of the ids {ids} → give each '
        'landmark an id of its own',
    'id_at_two_places': 'landmark {id} is seen now at ({x:.1f}, {y:.1f}, {z:.1f}) m, now at '
        '({other_x:.1f}, {other_y:.1f}, {other_z:.1f}) m: its id is there twice, or it is moved '
        'to and fro → look for its id at both places, and give one of the two another id',
    'reserved_id': 'not used: points with the ids {ids}; those from {first} to {last} number '
        'landmarks without an id → give these others',
    'impossible_id': 'not used: {count} points of an observation, whose ids are fractional, below '
        '-1, or more than their field holds → look at what the driver writes there; -1 is a point '
        'without id',
    'unknown_id': 'points without an id are not used by {gains} gains → only riccati gains use '
        'them',
    'half_point_without_id': 'not used: {count} bearings or ranges alone of an observation, which '
        'have no id → let the driver say of which landmark each is: by where it is none is '
        'recognised',
    'bad_point': 'not used: {count} points of an observation of which a covariance, velocity or '
        'orientation is NaN or infinite; its other points are used → let the publisher give '
        'numbers; all zeros mean that a covariance is unknown',
    'vague_point': '{count} points are stated with a standard deviation beyond {limit_m:.0f} m in '
        'every direction: they say nothing → state covariances in m², or zeros where they are '
        'unknown: then the settings apply',
    'surplus_point': 'an observation of {source} has {count} points, more than are used in time: '
        '{most} are, known landmarks first, then the nearest in each direction → see whether '
        'these are landmarks, and not the points of a lidar or depth camera; let the sensor or '
        'its driver send fewer, or set max_points higher, or constant gains',
    'full_map': 'the map has {count} landmarks, and max_landmarks is {limit}: from now on a new '
        'one replaces the one seen least often → if so many are right, set it higher; if not, '
        'look for ids that the sensor makes up',
    'large_map': 'the map has {count} landmarks. Where they move, time and memory that riccati '
        'gains take grow with their square: 70 ms a step and 0.5 GB for 600 landmarks in space → '
        'max_landmarks limits them; landmark_velocity_stddev: 0.0 is for landmarks at rest: many '
        'of these cost no more than few',
    'loaded_map': 'the loaded map has {count} landmarks, and max_landmarks is {limit}: what is '
        'not seen of it makes room for new ones → to keep them, set it higher, or '
        'localization_mode: uncertain',
    'left_out_correlations': 'correlations between the {count} landmarks of the map are not '
        'saved, they are too many → where it is loaded their errors count as independent: limit '
        'it by max_landmarks',
    'more_than_max': '{count} points in one message, and max_landmarks is {limit} → some are '
        'always new; set it higher, or send fewer points',
    'moved_landmark': 'landmarks {ids} have moved → if they have not, state more noise, or look '
        'at odometry and ids',
    'carried_landmark': 'landmarks {ids} move with the robot, and are not used → do nothing if it '
        'carries them; where they stay behind they are used again',
    'many_moved': '{count} landmarks seem to have moved within a minute: odometry may err by more '
        'than is stated → look for a bias or scale that is larger than stated, or not estimated '
        '(angular_bias_stddev and the like), noise that is set too small, and time without '
        'messages (unknown_linear_motion, unknown_angular_motion)',
}  # fmt: skip
"""By kind: what is wrong, with names in braces for figures, → and what to do."""

MISTAKES = frozenset({
    'no_turning', 'mount_off', 'points_in_optical_axes', 'points_mirrored', 'points_backwards',
    'points_in_millimetres', 'tag_size', 'turning_in_degrees', 'speed_in_kmh',
    'turning_negated', 'driving_negated',
})  # fmt: skip
"""Kinds of finding that name a mistake of the set-up."""

_NOTES = (
    'axis_noise', 'motion_noise', 'point_noise', 'large_noise', 'error_growth',
    'overconfident_pose', 'side_undecided',
)  # fmt: skip
_ERRORS = MISTAKES | {'unused_input', 'contradicted_pose', 'diverged'}
_LEVELS = dict.fromkeys(_NOTES, Level.NOTE) | dict.fromkeys(_ERRORS, Level.ERROR)

KINDS = {
    kind: Finding(kind, _LEVELS.get(kind, Level.WARNING), what, remedy)
    for kind, text in _TEXTS.items()
    for what, remedy in [text.split(' → ')]
}
"""Each kind of finding, with names in braces for its figures."""

FAULTS = {
    # The inputs of a node
    'nothing_published': "nothing publishes on '{topic}' ({wanted} is needed)",
    'other_type': "'{topic}' carries {types}; {wanted} is needed{hint}",
    'other_quality':
        "'{node}' can't be heard on '{topic}', its quality of service does not fit: "
        '{reason}',
    'missing_package': "'{topic}' can't be heard: {error}",
    'no_message_yet': "no message yet on '{topic}' ({wanted})",
    'no_message_any_more': "no message on '{topic}' for {for_s:.0f} s, though it has a publisher",
    'clock_stands': "/clock stands still for {for_s:.0f} s, and nothing comes on '{topic}': go on "
        'with the simulation or the recording',
    'busy_node': "the node was busy for {for_s:.1f} s, in which it read nothing on '{topic}': set "
        'max_points or max_landmarks lower if it often is',
    'slow_node': "the node does not keep up: messages on '{topic}' wait {wait_s:.1f} s to be "
        'read; send fewer of them, or make observations cheaper (max_landmarks)',
    'overload': "the node does not keep up: of {rate_hz:.1f} messages a second on '{topic}' it "
        'uses {used_hz:.1f}, the newest (dropped: overload); send no more than that, or fewer '
        'points in each, or make observations cheaper (max_landmarks)',
    # Their clocks
    'stamps_of_1970': 'stamps on {topic} are of 1970: they count from the start of a driver or '
        'machine (let it stamp with the time of ROS, or set correct_clock_offset), or are of a '
        'simulation ({simulation})',
    'stamps_off': 'stamps on {topic} are {off}{late} {advice}, or set correct_clock_offset',
    'stamp_ahead': "a stamp on {topic} was {ahead_s:.3f} s ahead of this machine's clock: "
        '{advice}',
    'odometry_ahead': "'{odom_frame}' to '{base_frame}' on /tf is {ahead_s:.3f} s ahead of this "
        "machine's clock: synchronise the clocks of what publishes it",
    # Its transform
    'odometry_behind': "'{odom_frame}' to '{base_frame}' on /tf is {behind}: '{map_frame}' to "
        "'{odom_frame}' waits for it; look at what publishes it",
    'odometry_too_new': 'odometry on /tf is stamped far ahead of the estimate: {error}',
    'other_parent': "'{base_frame}' has the parent '{parent}' on /tf, so that no pose is "
        'published there: set odom_frame to the frame of the odometry, or base_frame to the '
        "robot's uppermost frame, or publish_tf to false",
    'rival': "another node publishes '{parent}' to '{child}' on {topic}, too: end it (it may be "
        '{whose}), give each robot its own frames, or set publish_tf to false',
}  # fmt: skip
"""What inputs, clocks and transforms of a node have, and what to do about it."""


def found(kind: str, /, **figures: object) -> Finding:
    """Return a finding of a kind, with its figures in words."""
    stated = KINDS[kind]
    texts = (stated.what.format(**figures), stated.remedy.format(**figures))
    return Finding(kind, stated.level, *texts)


def fault(kind: str, /, **figures: object) -> str:
    """Return a fault of a node in words, with its figures."""
    return FAULTS[kind].format(**figures)


OF_ODOMETRY = frozenset({
    'late_odometry', 'implausible_calibration', 'noisy_odometry', 'axis_noise', 'motion_noise',
    'small_noise',
})  # fmt: skip
"""Symptoms that speak of the delay and the noise of the odometry."""

_OF_POSE = frozenset({
    'unknown_pose', 'no_place', 'other_hall', 'other_ids', 'lost_pose', 'contradicted_pose',
    'diverged',
})  # fmt: skip

SYMPTOMS = OF_ODOMETRY | _OF_POSE | {
    'rejected_points', 'left_out_points', 'unmapped_points', 'drive_a_curve', 'wrong_pose',
    'not_relinearised', 'slip', 'unexpected_place', 'moved_landmark', 'many_moved',
    'carried_landmark', 'id_at_two_places', 'mounting', 'range_scale', 'depth_for_range',
    'point_noise', 'large_noise', 'overconfident_pose', 'error_growth',
}  # fmt: skip
"""Findings that a mistake of the set-up may cause, and whose remedies would then be untrue."""

EXPLAINED: Mapping[str, frozenset[str]] = {
    **dict.fromkeys(MISTAKES, SYMPTOMS | {'rare_velocity'}),
    # Where the robot is must be known, whatever the reason.
    'several_publishers': (SYMPTOMS | MISTAKES | {'rare_velocity'}) - _OF_POSE,
    'rare_velocity': OF_ODOMETRY,
}
"""By the kinds of causes: which findings they explain, whose remedies would be untrue."""

ODOMETRY_CAUSES = frozenset(EXPLAINED) - MISTAKES  # by which nothing is learnt of the odometry

SUSPICIOUS = SYMPTOMS - {'large_noise', 'error_growth', 'axis_noise', 'left_out_points'}
"""Symptoms that are reason to look for a mistake."""


def explained(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings without those that another one of them explains."""
    findings = list(findings)
    known = {each.kind for each in findings}
    # A symptom explains nothing in its turn.
    causes = known.difference(*(EXPLAINED.get(kind, ()) for kind in known))
    symptoms = {kind for cause in causes for kind in EXPLAINED.get(cause, ())}
    return [each for each in findings if each.kind not in symptoms]


class _Keeper(logging.Handler):
    """Keeps the warnings: findings, and others as text."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.warnings: list[Finding | str] = []
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one record, unless another thread's run gave it."""
        if record.thread != self._thread:
            return
        first = record.args[0] if isinstance(record.args, tuple) and record.args else None
        text = ' '.join(record.getMessage().split())
        self.warnings.append(first if isinstance(first, Finding) else text)


_LOGGER = logging.getLogger('slam_observer_ros')


@contextmanager
def kept_warnings() -> Iterator[list[Finding | str]]:
    """Give a list that the package's warnings are added to, beside being shown."""
    keeper = _Keeper()
    _LOGGER.addHandler(keeper)
    try:
        yield keeper.warnings
    finally:
        _LOGGER.removeHandler(keeper)


@contextmanager
def muted_warnings() -> Iterator[None]:
    """Show none of the package's warnings meanwhile."""
    level = _LOGGER.level
    _LOGGER.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        _LOGGER.setLevel(level)


def worst_first(findings: Sequence[Finding], faults: Sequence[str]) -> list[str]:
    """Return what is wrong in words: errors, then faults of the inputs, then the rest.

    Faults come before other warnings, which may be their symptoms.
    """
    by_level = sorted(findings, key=lambda finding: -finding.level)
    errors = [finding.what for finding in by_level if finding.level == Level.ERROR]
    return [*errors, *faults, *(each.what for each in by_level[len(errors) :])]


def in_brief(texts: Sequence[str], most: int = 3, joint: str = '; ') -> str:
    """Return the first texts on one line, and how many more there are, to be looked up."""
    more = len(texts) - most
    return joint.join([*texts[:most], *([f'and {more} more'] if more > 0 else [])])
