"""Progress, timings, cancellation and the time budget."""

import time

import pytest

from csgm_ros.errors import Cancelled
from csgm_ros.progress import STAGES, Clock


def heard_of(attempts):
    heard = []
    clock = Clock(lambda *call: heard.append(call))
    for attempt in range(attempts):
        clock.begin(attempt)
        for stage in STAGES:
            clock.enter(stage)
            clock.report()
    clock.finish()
    return clock, heard


def test_names_the_stages_in_their_order_and_ends_with_all_done():
    _, heard = heard_of(1)
    assert [stage for stage, _ in heard[:-1:2]] == list(STAGES)
    assert heard[1::2] == heard[:-1:2]
    assert heard[-1] == ('done', 1.0)


@pytest.mark.parametrize('attempts', [1, 2, 5])
def test_the_fraction_never_falls_and_is_1_only_at_the_end(attempts):
    _, heard = heard_of(attempts)
    fractions = [fraction for _, fraction in heard]
    assert fractions == sorted(fractions)
    assert fractions[0] == 0.0
    assert fractions.index(1.0) == len(fractions) - 1


def test_timings_are_those_of_ended_stages_and_add_up():
    begin = time.perf_counter()
    clock, _ = heard_of(2)
    assert list(clock.timings) == list(STAGES)
    assert all(seconds >= 0.0 for seconds in clock.timings.values())
    assert sum(clock.timings.values()) <= time.perf_counter() - begin


def test_without_a_budget_there_is_always_time():
    assert not Clock().expired
    assert not Clock(time_budget=3600.0).expired


def test_a_spent_budget_is_told():
    begin = time.perf_counter()
    clock = Clock(time_budget=1e-6)
    while time.perf_counter() <= begin + 1e-3:
        pass
    assert clock.expired


def test_what_the_caller_raises_stops_the_work():
    def cancel(stage, fraction):
        raise Cancelled(f'{stage} at {fraction}')

    clock = Clock(cancel)
    with pytest.raises(Cancelled, match=rf'{STAGES[0]} at 0\.0'):
        clock.enter(STAGES[0])
    with pytest.raises(Cancelled):
        clock.report()
