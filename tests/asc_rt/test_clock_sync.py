"""The clock of another machine: the truth is always inside the bounds, and a clock that was set is never trusted."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from asc_rt.clock_sync import DRIFT, Answer, ClockOffset

MS = 1_000_000
ways = st.integers(0, 80 * MS)
asked = st.lists(st.tuples(st.integers(MS, 2_000 * MS), ways, ways), min_size=1, max_size=12)


def answers(offset: int, drift: float, rounds: list[tuple[int, int, int]]) -> list[tuple[Answer, float]]:
    """Each with the true offset at the moment it is heard. The cell's clock runs at (1 + drift) of ours."""
    found, now = [], 1_000_000 * MS
    for pause, there, back in rounds:
        now += pause
        t1 = offset + round((now + there) * (1.0 + drift))
        t3 = now + there + back
        found.append((Answer(now, t1, t3), offset + t3 * drift))
        now = t3
    return found


@given(
    st.integers(-(10**15), 10**15),
    st.floats(-DRIFT, DRIFT),
    asked,
    st.integers(0, 60_000 * MS),
)
def test_the_truth_is_within_the_bounds(
    offset: int, drift: float, rounds: list[tuple[int, int, int]], later: int
) -> None:
    clock = ClockOffset()
    for answer, true in answers(offset, drift, rounds):
        clock.heard(answer)
        found = clock.at(answer.t3_ns)
        assert found is not None
        assert abs(found[0] - true) <= found[1] + 2
        assert found[1] <= (0.5 + DRIFT) * (answer.t3_ns - answer.t0_ns) + 2, "worse than the newest answer alone"
    found = clock.at(answer.t3_ns + later)
    assert found is not None
    assert abs(found[0] - (true + later * drift)) <= found[1] + 2


def test_nothing_is_known_before_the_first_answer_and_the_bounds_grow_after_the_last() -> None:
    clock = ClockOffset()
    assert clock.at(5) is None
    clock.heard(Answer(0, 100 * MS, 2 * MS))
    at_once, later = clock.at(2 * MS), clock.at(10_002 * MS)
    assert at_once == (99 * MS, MS + 400 + 1)  # and the drift of 2 ms
    assert later is not None and later[1] == MS + 400 + 2 * MS + 1  # 200 ppm of 10 s


def test_a_clock_that_was_set_is_not_believed_until_a_second_answer_agrees() -> None:
    clock = ClockOffset()
    for k in range(3):
        clock.heard(Answer(k * MS, k * MS + 500_000, (k + 1) * MS))
    assert clock.at(3 * MS) is not None
    clock.heard(Answer(4 * MS, 9_000 * MS, 5 * MS))
    assert clock.at(5 * MS) is None
    clock.heard(Answer(6 * MS, 9_002 * MS, 7 * MS))
    found = clock.at(7 * MS)
    assert found is not None and abs(found[0] - (8_995.5 * MS)) <= found[1] < MS
