"""Who sets the rhythm: tested with a clock that only the test moves."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from asc_rt.pacing import SEQUENCE_SPAN, DevicePaced, HostPaced, make
from drivers.base import Pacing

PERIOD = 8_000_000


class FakeClock:
    def __init__(self) -> None:
        self.now = 1_000_000_000

    def __call__(self) -> int:
        return self.now

    def sleep(self, until: int) -> None:
        self.now = max(self.now, until)


def test_each_driver_gets_its_pacer() -> None:
    assert isinstance(make(Pacing.DEVICE, PERIOD), DevicePaced)
    assert isinstance(make(Pacing.HOST, PERIOD), HostPaced)


# --- the robot's samples ---------------------------------------------------------------------------------------------


def test_a_sample_is_waited_for_half_a_period_longer_than_due() -> None:
    clock = FakeClock()
    pacer = DevicePaced(PERIOD, clock)
    assert pacer.deadline_ns() == clock.now + PERIOD * 3 // 2
    clock.now += PERIOD + 100
    pacer.began(clock.now, 7)
    assert pacer.deadline_ns() == clock.now + PERIOD * 3 // 2
    assert (pacer.missed, pacer.late) == (0, False)


def test_silence_is_one_cycle_for_each_period() -> None:
    clock = FakeClock()
    pacer = DevicePaced(PERIOD, clock)
    begins = []
    for _ in range(5):
        clock.now = pacer.deadline_ns()
        pacer.began(clock.now, None)
        begins.append(clock.now)
        assert (pacer.missed, pacer.late) == (0, False)
    assert {b - a for a, b in zip(begins, begins[1:], strict=False)} == {PERIOD}


def test_a_stall_of_ours_is_not_followed_by_a_burst_of_silent_cycles() -> None:
    clock = FakeClock()
    pacer = DevicePaced(PERIOD, clock)
    clock.now += 10 * PERIOD
    pacer.began(clock.now, None)
    assert pacer.late
    assert pacer.deadline_ns() > clock.now


def test_numbers_that_the_robot_skipped_are_missed_and_repetitions_are_not() -> None:
    pacer = DevicePaced(PERIOD, FakeClock())
    missed = []
    for seq in (10, 11, 14, 14, 15, 3):
        pacer.began(0, seq)
        missed.append(pacer.missed)
    assert missed == [0, 0, 2, 0, 0, 0]


def test_silent_cycles_do_not_hide_a_gap_in_the_numbers() -> None:
    pacer = DevicePaced(PERIOD, FakeClock())
    for seq in (10, None, None, 13):
        pacer.began(0, seq)
    assert pacer.missed == 2


def test_numbers_wrap_around() -> None:
    pacer = DevicePaced(PERIOD, FakeClock())
    for seq in (SEQUENCE_SPAN - 1, 1):
        pacer.began(0, seq)
    assert pacer.missed == 1


def test_a_late_cycle_is_called_late() -> None:
    clock = FakeClock()
    pacer = DevicePaced(PERIOD, clock)
    pacer.began(clock.now + 2 * PERIOD, 1)
    assert not pacer.late
    pacer.began(clock.now + 4 * PERIOD + 1, 2)
    assert pacer.late


# --- this PC's clock -------------------------------------------------------------------------------------------------


def host() -> tuple[FakeClock, HostPaced]:
    clock = FakeClock()
    return clock, HostPaced(PERIOD, clock, clock.sleep)


def test_deadlines_are_absolute() -> None:
    clock, pacer = host()
    start = clock.now
    for k in range(1, 6):
        pacer.began(clock.now, k)
        clock.now += 3_000_000  # the cycle's own work does not shift the rhythm
        pacer.wait()
        assert clock.now == start + k * PERIOD
        assert not pacer.late


def test_missed_periods_are_skipped_counted_and_never_made_up_for() -> None:
    clock, pacer = host()
    start = clock.now
    pacer.began(clock.now, 0)
    clock.now += 3 * PERIOD + 1  # the work took more than three periods
    pacer.wait()
    assert clock.now == start + 3 * PERIOD + 1  # at once: the cycle of the third period is due
    pacer.began(clock.now, 1)
    assert pacer.missed == 2
    pacer.wait()
    assert clock.now == start + 4 * PERIOD
    pacer.began(clock.now, 2)
    assert pacer.missed == 0


@given(st.lists(st.integers(0, 5 * PERIOD), min_size=1, max_size=50))
def test_there_are_never_more_cycles_than_periods(work: list[int]) -> None:
    """Whatever the cycles cost: those that ran and those that were missed are the periods that passed."""
    clock, pacer = host()
    start, missed = clock.now, 0
    for cost in work:
        pacer.began(clock.now, 0)
        missed += pacer.missed
        clock.now += cost
        pacer.wait()
    pacer.began(clock.now, 0)
    missed += pacer.missed
    assert len(work) + missed == (clock.now - start) // PERIOD
