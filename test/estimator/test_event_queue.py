"""The event queue: stamp order whatever the order of arrival, duplicates, jumps of the clock."""

from __future__ import annotations

import contextlib
import dataclasses

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from slam_observer_ros.common.errors import InvalidEventError
from slam_observer_ros.common.stamps import AGREEING_STAMPS
from slam_observer_ros.estimator.event_queue import EventQueue, MIN_KNOWN
from slam_observer_ros.events import (
    AngularVelocityEvent,
    ObservationEvent,
    VelocityBlock,
    VelocityEvent,
)

SECOND = 1_000_000_000
START_NS = 1_700_000_000 * SECOND


def velocity(stamp_ns):
    return VelocityEvent(START_NS + stamp_ns, np.zeros(6))


def received(event, receive_ns):
    is_block = isinstance(event, VelocityBlock)
    times_ns = np.array([receive_ns]) if is_block else receive_ns
    return dataclasses.replace(event, receive_ns=times_ns)


def observation(stamp_ns, ids=(1,), range_m=0.0):
    points = np.full((len(ids), 3), range_m)
    return ObservationEvent(START_NS + stamp_ns, np.array(ids), points)


def make_queue(window_ns=100, max_jump_ns=10 * SECOND, late_limit_ns=2 * SECOND):
    return EventQueue(window_ns, max_jump_ns, late_limit_ns)


def dense(stop_ns, step_ns=SECOND // 50):
    return [velocity(stamp_ns) for stamp_ns in range(0, stop_ns, step_ns)]


def filled(*events, **limits):
    queue = make_queue(**limits)
    for event in events:
        assert not queue.push(event)
    return queue


def key(event):
    ids = event.ids.tobytes() if isinstance(event, ObservationEvent) else b''
    return event.stamp_ns, type(event).__name__, ids


def stamps(events):
    return [event.stamp_ns - START_NS for event in events]


def test_events_are_held_back_until_they_leave_the_window():
    queue = filled(velocity(0), velocity(60), velocity(110))
    assert stamps(queue.pop_ready()) == [0]
    assert stamps(queue.pop_ready()) == []
    queue.push(velocity(160))
    assert stamps(queue.pop_ready()) == [60]
    assert stamps(queue.pop_all()) == [110, 160]
    assert queue.newest_ns == START_NS + 160


def test_without_a_window_events_come_out_at_once():
    queue = filled(velocity(5), window_ns=0)
    assert stamps(queue.pop_ready()) == [5]


@given(st.permutations(range(12)))
def test_the_order_of_arrival_within_the_window_does_not_matter(order):
    events = [velocity(10 * k) for k in range(4)]
    events += [observation(10 * k, ids) for k in range(4) for ids in ([1], [2, 3])]
    queue = filled(*(events[place] for place in order))
    given_out = [key(event) for event in queue.pop_all()]
    assert given_out == [key(event) for event in filled(*events).pop_all()]
    assert [stamp_ns for stamp_ns, *_ in given_out] == sorted(event.stamp_ns for event in events)


def test_of_one_stamp_all_velocities_come_first():
    """However the digest of an observation compares with the name of a class."""
    events = [*(observation(7, [number]) for number in range(20)), velocity(7)]
    events.append(AngularVelocityEvent(events[0].stamp_ns, np.zeros(3)))
    given_out = filled(*events).pop_all()
    kinds = [isinstance(event, ObservationEvent) for event in given_out]
    assert kinds == [False, False, *[True] * 20]


@pytest.mark.parametrize('event', [velocity(3), observation(3), observation(3, [])])
@pytest.mark.parametrize('is_given_out', [False, True])
def test_an_event_that_comes_twice_is_refused(event, is_given_out):
    queue = filled(event, velocity(150 if is_given_out else 50))
    assert len(list(queue.pop_ready())) == is_given_out
    with pytest.raises(InvalidEventError) as error:
        queue.push(event)
    assert error.value.reason == 'duplicate'


@pytest.mark.parametrize('of_another', [observation(3, [4]), observation(3, [1, 2], range_m=5.0)])
def test_two_sensors_may_see_landmarks_at_one_instant(of_another):
    queue = filled(observation(3, [1, 2]), of_another)
    assert len(list(queue.pop_all())) == 2


def test_what_is_known_of_an_event_does_not_grow_with_its_points():
    queue = filled(observation(3, range(10_000)))
    ((_, _, content),) = queue._events.known
    assert len(content) < 100


def test_keys_of_old_events_are_forgotten():
    queue = make_queue()
    for k in range(2000):
        queue.push(velocity(SECOND // 100 * k))
        queue.pop_ready()
    assert len(queue._events.known) <= MIN_KNOWN


def test_however_many_events_came_since_a_late_one_that_comes_twice_is_refused():
    events = dense(SECOND, step_ns=SECOND // (2 * MIN_KNOWN))
    with pytest.raises(InvalidEventError) as error:
        filled(*events).push(events[MIN_KNOWN])
    assert error.value.reason == 'duplicate'


def test_how_late_an_event_may_be_is_counted_from_the_newest_one_not_from_another_late_one():
    queue = filled(velocity(2 * SECOND), velocity(SECOND))
    assert queue.newest_ns == START_NS + 2 * SECOND
    with pytest.raises(InvalidEventError) as error:
        queue.push(velocity(-SECOND // 2))
    assert error.value.reason == 'too_late'


@pytest.mark.parametrize('begun_s', [0, 1])
def test_a_pause_may_be_no_longer_than_asked_for_however_short_that_is(begun_s):
    queue = filled(velocity(0), *dense(begun_s * SECOND)[1:], max_jump_ns=SECOND // 2)
    with pytest.raises(InvalidEventError) as error:
        queue.push(velocity(begun_s * SECOND + SECOND * 6 // 10))
    assert error.value.reason == 'stamp_jump'


@pytest.mark.parametrize(
    ('stamp_ns', 'reason'),
    [
        (12 * SECOND + 1, 'stamp_jump'),
        (-101, 'too_late'),
        (-START_NS, 'too_late'),
    ],
)
def test_stamps_far_from_all_others_are_refused(stamp_ns, reason):
    queue = filled(velocity(0), velocity(2 * SECOND))
    list(queue.pop_ready())
    with pytest.raises(InvalidEventError) as error:
        queue.push(velocity(stamp_ns))
    assert error.value.reason == reason
    assert '\n' not in str(error.value)
    assert queue.newest_ns == START_NS + 2 * SECOND


@pytest.mark.parametrize('stamp_ns', [12 * SECOND, 2 * SECOND, 2 * SECOND - 1, -100])
def test_stamps_at_the_limits_are_taken(stamp_ns):
    queue = filled(velocity(0), velocity(2 * SECOND))
    assert not queue.push(observation(stamp_ns))


@pytest.mark.parametrize('late_limit_ns', [0, 2 * SECOND])
@pytest.mark.parametrize('ahead_s', [0.5, 2.5, 9.0, 20.0])
def test_one_stamp_ahead_is_no_jump_of_the_clock(ahead_s, late_limit_ns):
    queue = filled(*dense(SECOND), late_limit_ns=late_limit_ns)
    with contextlib.suppress(InvalidEventError):
        assert not queue.push(velocity(SECOND + round(ahead_s * SECOND) + 1))
    for event in dense(20 * SECOND)[50:]:
        with contextlib.suppress(InvalidEventError):
            assert not queue.push(event)
        queue.pop_ready()
    assert queue.newest_ns == event.stamp_ns


def test_nothing_is_lost_after_one_stamp_ahead():
    queue = filled(*dense(SECOND), velocity(6 * SECOND + 1), *dense(9 * SECOND)[50:])
    assert stamps(queue.pop_all()) == sorted([*stamps(dense(9 * SECOND)), 6 * SECOND + 1])


def test_what_still_waits_for_others_at_the_end_is_given_out_too():
    queue = filled(
        *dense(2 * SECOND), velocity(9 * SECOND), *map(velocity, (2 * SECOND, SECOND * 5 // 2))
    )
    assert stamps(queue.pop_all())[-3:] == [2 * SECOND, 5 * SECOND // 2, 9 * SECOND]


def test_a_pause_is_believed_when_enough_events_agree_and_none_of_them_is_lost():
    events = [*dense(SECOND), *dense(11 * SECOND)[540:]]
    queue = filled(*events[: 50 + AGREEING_STAMPS - 1])
    assert queue.newest_ns == events[49].stamp_ns
    for event in events[50 + AGREEING_STAMPS - 1 :]:
        assert not queue.push(event)
        assert queue.newest_ns == event.stamp_ns
    assert queue.pop_all() == events


def test_after_a_pause_the_newest_stamp_is_the_largest_in_whatever_order_they_came():
    after = [velocity(6 * SECOND - n) for n in range(AGREEING_STAMPS)]
    assert filled(*dense(SECOND), *after).newest_ns == after[0].stamp_ns


def test_one_stamp_far_behind_is_no_jump_of_the_clock_right_after_a_pause():
    queue = filled(*dense(SECOND), *[velocity(6 * SECOND + n) for n in range(AGREEING_STAMPS)])
    with pytest.raises(InvalidEventError):
        queue.push(velocity(3 * SECOND))


LONG_NS = 900 * SECOND


def before_and_after_a_silence(received_before_ns=0):
    """Events at 50 Hz for a second, and for another one after a silence of 15 minutes."""
    before, after = dense(SECOND), [velocity(LONG_NS + n * SECOND // 50) for n in range(50)]
    delayed = [received(event, 7 * n + received_before_ns) for n, event in enumerate(before)]
    return delayed, [received(event, LONG_NS + SECOND) for event in after]


def test_a_silence_of_any_length_is_no_jump_of_the_clock():
    before, after = before_and_after_a_silence()
    assert filled(*before, *after).pop_all() == [*before, *after]


def test_a_message_that_is_quicker_after_a_silence_than_all_before_makes_it_no_jump():
    before, (first, *_) = before_and_after_a_silence(received_before_ns=SECOND)
    assert not filled(*before).push(received(first, LONG_NS))


def test_what_was_received_only_after_a_silence_does_not_make_it_a_jump():
    before, after = before_and_after_a_silence()
    kept = [received(event, LONG_NS) for event in before[30:]]
    assert filled(*before[:30], *kept, *after).newest_ns == after[-1].stamp_ns


def test_a_stamp_ahead_waits_after_a_silence_and_is_refused_where_there_was_none():
    before, after = before_and_after_a_silence()
    queue = filled(*before, after[0])
    assert queue.newest_ns == before[-1].stamp_ns
    with pytest.raises(InvalidEventError):
        queue.push(received(velocity(LONG_NS + 20 * SECOND), LONG_NS + SECOND))
    with pytest.raises(InvalidEventError):
        filled(*before).push(received(velocity(12 * SECOND), SECOND))


@pytest.mark.parametrize('is_first_received', [False, True])
def test_a_time_of_reception_that_some_events_have_not_is_no_silence(is_first_received):
    first, ahead = velocity(0), velocity(20 * SECOND)
    if is_first_received:
        queue = filled(received(first, 0))
    else:
        queue, ahead = filled(first), received(ahead, 20 * SECOND)
    with pytest.raises(InvalidEventError) as error:
        queue.push(ahead)
    assert error.value.reason == 'stamp_jump'


def test_stamps_that_go_on_further_than_time_does_are_a_jump_of_the_clock():
    before, after = before_and_after_a_silence(received_before_ns=LONG_NS - 5 * SECOND)
    queue = filled(*before)
    for event in after[: AGREEING_STAMPS - 1]:
        with pytest.raises(InvalidEventError):
            queue.push(event)
    assert queue.push(after[AGREEING_STAMPS - 1])


def test_where_events_come_seldom_none_waits_for_others():
    events = [velocity(5 * SECOND * n + SECOND * (n % 2)) for n in range(12)]
    queue = filled(*events[: 1 + AGREEING_STAMPS], window_ns=0)
    assert queue.pop_ready() == events[: 1 + AGREEING_STAMPS]
    for event in events[1 + AGREEING_STAMPS :]:
        assert not queue.push(event)
        assert queue.pop_ready() == [event]


def test_where_events_come_seldom_but_two_at_once_none_waits_for_others():
    queue = filled(*dense(30 * SECOND, step_ns=5 * SECOND), window_ns=0)
    for stamp_ns in range(30 * SECOND, 60 * SECOND, 5 * SECOND):
        assert not queue.push(velocity(stamp_ns))
        assert not queue.push(observation(stamp_ns))
        assert queue.newest_ns == START_NS + stamp_ns


def test_events_of_one_message_do_not_confirm_each_other():
    queue = filled(*dense(SECOND))
    for number in range(2 * AGREEING_STAMPS):
        assert not queue.push(observation(5 * SECOND, [number]))
    assert queue.newest_ns < START_NS + SECOND


def test_a_sensor_with_a_clock_that_is_ahead_waits_for_the_others():
    queue = make_queue()
    for event in dense(10 * SECOND):
        assert not queue.push(event)
        assert not queue.push(observation(event.stamp_ns - START_NS + 3 * SECOND))
    assert queue.newest_ns == event.stamp_ns


def test_stamps_that_do_not_agree_confirm_no_jump():
    queue = filled(*dense(SECOND))
    for far_s in (100, -20, 200, -40, 1000, 300, -70, 500):
        with pytest.raises(InvalidEventError):
            queue.push(velocity(far_s * SECOND))


def test_stamps_behind_all_others_and_ahead_of_them_confirm_no_jump():
    queue = filled(*dense(SECOND))
    for n in range(2 * AGREEING_STAMPS):
        assert not queue.push(velocity(5 * SECOND + n))
        with pytest.raises(InvalidEventError):
            queue.push(velocity(n - 3 * SECOND))
    assert queue.newest_ns < START_NS + SECOND


@pytest.mark.parametrize('jump_ns', [10**15, -(10**15), -3 * SECOND, -START_NS])
def test_a_jump_of_the_clock_is_believed_when_enough_events_agree(jump_ns):
    queue = filled(velocity(0))
    for k in range(AGREEING_STAMPS - 1):
        with pytest.raises(InvalidEventError):
            queue.push(velocity(jump_ns + k))
    assert queue.push(velocity(jump_ns + AGREEING_STAMPS))


def test_strays_among_good_events_never_add_up():
    queue = filled(velocity(0))
    for k in range(1, 50):
        with pytest.raises(InvalidEventError):
            queue.push(velocity(10**15 + k))
        assert not queue.push(velocity(k))


def push_or_reason(queue, event):
    try:
        return queue.push(event)
    except InvalidEventError as error:
        return error.reason


@pytest.mark.parametrize('held_up_since_s', [6, 2])
def test_a_burst_of_what_was_held_up_is_no_jump_of_the_clock(held_up_since_s):
    """Of one detector, or of a second one: then observations have gone on meanwhile."""
    queue = make_queue()
    for event in dense(10 * SECOND):
        stamp_ns = event.stamp_ns - START_NS
        queue.push(received(event, stamp_ns))
        if stamp_ns < 6 * SECOND:
            queue.push(received(observation(stamp_ns), stamp_ns))
    burst = [
        received(observation(held_up_since_s * SECOND + n * SECOND // 10), 10 * SECOND + n)
        for n in range(20)
    ]
    assert {push_or_reason(queue, event) for event in burst} == {'too_late'}


def test_a_sensor_that_is_always_too_late_goes_on_alone_without_a_jump_of_the_clock():
    queue = make_queue()
    for event in dense(10 * SECOND):
        assert not queue.push(event)
        push_or_reason(queue, observation(event.stamp_ns - START_NS - 3 * SECOND))
    alone = [observation(7 * SECOND + n * SECOND // 20) for n in range(18)]
    assert {push_or_reason(queue, event) for event in alone} == {'too_late'}
    assert queue.newest_ns == event.stamp_ns


def test_two_clocks_that_stand_still_confirm_no_jump():
    queue = filled(*dense(SECOND))
    stuck = [velocity(n % 2 - 20 * SECOND) for n in range(4 * AGREEING_STAMPS)]
    assert {push_or_reason(queue, event) for event in stuck} == {'too_late'}


def test_a_looped_recording_is_a_jump_of_the_clock_within_half_a_second():
    queue = make_queue()
    lap = dense(10 * SECOND)
    for event in lap:
        assert not queue.push(received(event, event.stamp_ns))
    again = [received(event, event.stamp_ns + 10 * SECOND) for event in lap[:25]]
    assert True in [push_or_reason(queue, event) for event in again]


def delays_ns(queue, events):
    """Return how far behind the newest stamp each event is given out, in order of arrival."""
    given_out = {}
    for event in events:
        queue.push(event)
        given_out |= {id(ready): queue.newest_ns for ready in queue.pop_ready()}
    return [given_out.get(id(event), queue.newest_ns) - event.stamp_ns for event in events]


def test_events_that_come_in_order_are_not_held_back_for_long():
    delays = delays_ns(make_queue(window_ns=SECOND // 20), dense(12 * SECOND))
    assert min(delays[:400]) >= SECOND // 20, 'it is not known yet how late they are'
    assert set(delays[-50:]) == {0}


def test_an_event_that_is_late_opens_the_window_as_far_as_allowed():
    queue = make_queue(window_ns=SECOND // 20)
    delays_ns(queue, dense(12 * SECOND))
    step_ns = SECOND // 50
    after = [velocity(12 * SECOND + k * step_ns) for k in range(1000)]
    late = [observation(12 * SECOND + step_ns // 2), observation(12 * SECOND + 2 * step_ns)]
    arrivals = [*after[:2], late[0], *after[2:10], late[1], *after[10:]]
    delays = delays_ns(queue, arrivals)
    assert delays[3:6] == [step_ns, step_ns, step_ns], 'twice the lateness of 10 ms'
    assert min(delays[13:100]) >= SECOND // 20, 'no further than its setting'
    assert set(delays[-50:]) == {0}, 'none was late for long'
