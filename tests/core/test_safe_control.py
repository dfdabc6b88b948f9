"""The QP against another solver, and its word on what cannot be solved."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from asc_rt.core import safe_control
from asc_rt.core.polytope import Polytope, pack
from asc_rt.core.safe_control import Solution, project, solve

SCALE = np.array([8.7, 8.7, 12.0, 19.0, 19.0, 35.0])


def box(lower: Any, upper: Any) -> Polytope:
    return Polytope(lower, upper, np.zeros((0, len(lower))), np.zeros(0), np.zeros(0))


def ask(u_ref: Any, C: Any, floor: Any, lower: Any, upper: Any) -> Solution:
    """Rows without a share."""
    return solve(u_ref, C, floor, floor, pack(box(lower, upper)), SCALE)


def driven_by_torque(u_ref: Any, C: Any, floor: Any, lower: Any, upper: Any, seed: int) -> Polytope:
    """The box, and torque limits that cut into it but leave its middle."""
    rng = np.random.default_rng(seed)
    A = rng.normal(0.0, 0.3, (6, 6))
    G = A @ A.T + 0.1 * np.eye(6)
    middle, room = G @ (0.5 * (lower + upper)), np.abs(G) @ (0.5 * (upper - lower))
    return Polytope(lower, upper, G, middle - rng.uniform(0.2, 1.2, 6) * room, middle + rng.uniform(0.2, 1.2, 6) * room)


def problems(count: int, seed: int = 0, rows: int = 8) -> Any:
    rng = np.random.default_rng(seed)
    for _ in range(count):
        centre = rng.uniform(-0.5, 0.5, 6) * SCALE
        half = rng.uniform(0.02, 0.5, 6) * SCALE
        C = rng.normal(0.0, 0.5, (rows, 6)) * 10.0 ** rng.uniform(-2.0, 0.0, (rows, 1))  # also links that hardly move
        yield (
            rng.uniform(-1.0, 1.0, 6) * SCALE,
            C,
            C @ centre + rng.normal(0.0, 2.0, rows) * np.abs(C).max(axis=1),
            centre - half,
            centre + half,
        )


def possible(C: Any, floor: Any, lower: Any, upper: Any) -> float:
    """Largest common margin of all rows, by linear programming; negative: infeasible."""
    best = linprog(
        np.append(np.zeros(6), -1.0),
        A_ub=np.hstack((-C, np.ones((len(C), 1)))),
        b_ub=-floor,
        bounds=[*zip(lower, upper, strict=True), (-100.0, 100.0)],
    )
    return float(-best.fun)


def nearest(u: Any, A: Any, b: Any, lower: Any, upper: Any) -> Any:
    """What another solver finds, in shares of SCALE: the closest to u with A x >= b in the box."""
    return minimize(
        lambda x: float(np.sum((x - u / SCALE) ** 2)),
        0.5 * (lower + upper) / SCALE,
        jac=lambda x: 2.0 * (x - u / SCALE),
        bounds=list(zip(lower / SCALE, upper / SCALE, strict=True)),
        constraints={"type": "ineq", "fun": lambda x: A @ (x * SCALE) - b, "jac": lambda x: A * SCALE},
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 200},
    )


def test_the_control_is_the_closest_that_keeps_everything() -> None:
    solved = 0
    for u_ref, C, floor, lower, upper in problems(150):
        margin = possible(C, floor, lower, upper)
        found = ask(u_ref, C, floor, lower, upper)
        if abs(margin) < 1e-3:
            continue
        assert found.feasible == (margin > 0.0) and found.share == 1.0
        if not found.feasible:
            continue
        assert np.all(C @ found.u >= floor) and np.all((lower <= found.u) & (found.u <= upper))
        other = nearest(u_ref, C, floor, lower, upper)
        if not other.success:
            continue
        np.testing.assert_allclose(found.u / SCALE, other.x, atol=2e-4)
        solved += 1
    assert solved > 60


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_torque_limits_are_kept_and_no_more_than_kept(rows: int) -> None:
    solved = 0
    for k, (u_ref, C, floor, lower, upper) in enumerate(problems(60, seed=5, rows=rows)):
        U = driven_by_torque(u_ref, C, floor, lower, upper, k)
        found = solve(3.0 * u_ref, C, floor, floor, pack(U), SCALE)
        A, b = np.vstack((C, U.G, -U.G)), np.concatenate((floor, U.low, -U.high))
        margin = possible(A, b, lower, upper)
        if abs(margin) < 1e-3:
            continue
        assert found.feasible == (margin > 0.0)
        if not found.feasible:
            continue
        assert np.all(A @ found.u >= b) and np.all((lower <= found.u) & (found.u <= upper))
        other = nearest(3.0 * u_ref, A, b, lower, upper)
        if other.success and np.all(A @ (other.x * SCALE) >= b - 1e-9):
            np.testing.assert_allclose(found.u / SCALE, other.x, atol=2e-4)
            solved += 1
    assert solved > 20


def test_torque_limits_that_nothing_in_the_box_can_exceed_change_no_bit() -> None:
    for u_ref, C, floor, lower, upper in problems(40, seed=6, rows=3):
        G = np.random.default_rng(0).normal(0.0, 1.0, (6, 6))
        low, high = (np.minimum(G * lower, G * upper).sum(axis=1), np.maximum(G * lower, G * upper).sum(axis=1))
        wide = pack(Polytope(lower, upper, G, low - 1e-5, high + 1e-5))
        without, with_limits = ask(u_ref, C, floor, lower, upper), solve(u_ref, C, floor, floor, wide, SCALE)
        assert without.feasible == with_limits.feasible and without.u.tobytes() == with_limits.u.tobytes()


def test_joints_that_have_no_choice_leave_it_to_the_others() -> None:
    """Boxes narrower than twice the margin that the solver gets."""
    for width in (0.0, 1e-7):
        lower = np.append(-SCALE[:1], 0.1 * SCALE[1:])
        upper = np.append(SCALE[:1], 0.1 * SCALE[1:] + width)
        C = np.array([[1.0, 0, 0, 0, 0, 0], [1.0, 0.01, 0, 0, 0, 0]])
        for rows in (1, 2):
            found = ask(np.zeros(6), C[:rows], np.array([2.0, 2.0])[:rows], lower, upper)
            assert found.feasible and np.all((lower <= found.u) & (found.u <= upper)), (width, rows)


def test_rows_in_conflict_are_infeasible() -> None:
    C = np.array([[1.0, 0, 0, 0, 0, 0], [-1.0, 0, 0, 0, 0, 0]])
    found = ask(np.zeros(6), C, np.array([0.5, 0.5]), -SCALE, SCALE)
    assert not found.feasible
    assert ask(np.zeros(6), C, np.array([0.5, -0.6]), -SCALE, SCALE).feasible


@pytest.mark.parametrize("floor", [np.nan, np.inf])
def test_a_floor_that_is_no_number_is_infeasible_even_alone(floor: float) -> None:
    C = np.ones((1, 6))
    assert not ask(np.zeros(6), C, np.array([floor]), -SCALE, SCALE).feasible
    assert not ask(np.zeros(6), np.zeros((1, 6)), np.array([floor]), -SCALE, SCALE).feasible


@pytest.mark.parametrize("where", ["C", "u_ref"])
def test_what_is_no_number_is_infeasible(where: str) -> None:
    C, u_ref = np.ones((1, 6)), np.zeros(6)
    (C[0] if where == "C" else u_ref)[2] = np.nan
    assert not ask(u_ref, C, np.array([0.1]), -SCALE, SCALE).feasible
    if where == "u_ref":
        assert not ask(u_ref, np.zeros((0, 6)), np.zeros(0), -SCALE, SCALE).feasible


def test_without_a_binding_row_the_reference_passes_or_meets_the_box() -> None:
    inside = ask(0.1 * SCALE, np.ones((1, 6)), np.array([-1e3]), -SCALE, SCALE)
    assert inside.feasible and not inside.filtered and inside.share == 1.0
    np.testing.assert_array_equal(inside.u, 0.1 * SCALE)
    outside = ask(9.0 * SCALE, np.zeros((0, 6)), np.zeros(0), -SCALE, SCALE)
    np.testing.assert_array_equal(outside.u, SCALE)


def test_rows_that_nothing_in_the_box_can_violate_change_no_bit() -> None:
    for u_ref, C, floor, lower, upper in problems(40, seed=1, rows=4):
        idle = np.random.default_rng(0).normal(0.0, 1.0, (20, 6))
        beneath = np.minimum(idle * lower, idle * upper).sum(axis=1) - 0.1
        alone = ask(u_ref, C, floor, lower, upper)
        crowded = ask(u_ref, np.vstack((idle, C)), np.concatenate((beneath, floor)), lower, upper)
        assert alone.feasible == crowded.feasible
        if alone.feasible:
            np.testing.assert_array_equal(alone.u, crowded.u)


def test_equal_problems_have_equal_bytes_whatever_was_solved_between() -> None:
    cases = list(problems(12, seed=2))
    first = [ask(*case) for case in cases]
    again = [ask(*case) for case in reversed(cases)][::-1]
    assert [s.u.tobytes() for s in first] == [s.u.tobytes() for s in again]


def test_a_box_of_no_width_is_still_solved() -> None:
    point = 0.2 * SCALE
    C = np.array([[1.0, 0, 0, 0, 0, 0]])
    assert ask(np.zeros(6), C, np.array([point[0] - 0.1]), point, point).feasible
    assert not ask(np.zeros(6), C, np.array([point[0] + 0.1]), point, point).feasible


def test_rows_with_a_share_give_way_and_the_others_do_not() -> None:
    """Two people, one on each side, both faster than the arm; and a row of the index, which holds."""
    C = np.array([[1.0, 0, 0, 0, 0, 0], [-1.0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0]])
    floor, base = np.array([2.0, 1.0, 3.0]), np.array([-0.5, -0.5, 3.0])
    found = solve(np.zeros(6), C, floor, base, pack(box(-SCALE, SCALE)), SCALE)
    assert found.feasible and found.filtered
    assert 0.0 < found.share < 1.0
    assert found.share == pytest.approx(1.0 / 4.0, abs=1e-3)  # -0.5 + 2.5 s <= u <= 0.5 - 1.5 s
    assert np.all(C @ found.u >= base + found.share * (floor - base) - 1e-9)
    assert found.u[1] >= 3.0
    stubborn = solve(np.zeros(6), C, floor, floor, pack(box(-SCALE, SCALE)), SCALE)
    assert not stubborn.feasible


ROW, OTHER = np.eye(6)[0], np.eye(6)[1]
FREE = 5.0 * np.ones(6)


@pytest.mark.parametrize(
    ("u", "solved"),
    [
        (2.0 * ROW, True),  # keeps one of two rows
        (2.0 * (ROW + OTHER) + 6.0 * np.eye(6)[4], True),  # outside the box
        (2.0 * (ROW + OTHER) - 6.0 * np.eye(6)[4], True),
        (2.0 * (ROW + OTHER) + 3.0 * np.eye(6)[5], True),  # above a torque limit
        (2.0 * (ROW + OTHER) - 3.0 * np.eye(6)[5], True),
        (2.0 * (ROW + OTHER) + np.nan * np.eye(6)[4], True),
        (2.0 * (ROW + OTHER), False),  # says itself that it is none
    ],
)
def test_the_solver_is_not_believed(u: Any, solved: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever it answers is measured at every row and limit."""
    most = np.where(np.arange(6) == 5, 2.0, FREE)
    torque = Polytope(-FREE, FREE, np.eye(6), -most, most)
    C, floor = np.array([ROW, OTHER]), np.ones(2)
    good = safe_control._Found(2.0 * (ROW + OTHER), 1.0, True, 7)
    for answer, feasible in ((good, True), (safe_control._Found(u, 1.0, solved, 7), False)):
        monkeypatch.setattr(safe_control, "_quadratic", lambda *_, answer=answer, **__: answer)
        found = solve(np.zeros(6), C, floor, floor, pack(torque), SCALE)
        assert (found.feasible, found.filtered, found.iterations) == (feasible, True, 7)
        assert project(9.0 * ROW, pack(torque), SCALE) is (answer.u if _fits(answer, torque) else None)


def test_the_share_that_is_told_is_measured_too(monkeypatch: pytest.MonkeyPatch) -> None:
    floor, base = np.array([3.0, 3.0]), np.array([1.0, 1.0])
    for u, kept in ((2.1 * (ROW + OTHER), True), (1.9 * (ROW + OTHER), False)):
        answers = iter([safe_control._Found(u, 1.0, False, 3), safe_control._Found(u, 0.5, True, 4)])
        monkeypatch.setattr(safe_control, "_quadratic", lambda *_, answers=answers: next(answers))
        found = solve(np.zeros(6), np.array([ROW, OTHER]), floor, base, pack(box(-FREE, FREE)), SCALE)
        assert (found.feasible, found.share, found.iterations) == (kept, 0.5, 7)


def test_each_program_has_the_solver_that_can_solve_it(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, piqp = [], safe_control._of_piqp
    monkeypatch.setattr(safe_control, "_of_piqp", lambda *program: asked.append(len(program[3])) or piqp(*program))
    torque = Polytope(-FREE, FREE, np.eye(6)[:1], np.array([-1.0]), np.array([1.0]))
    row, floor = np.array([ROW + OTHER]), np.array([1.5])
    assert solve(np.zeros(6), row, floor, floor, pack(box(-FREE, FREE)), SCALE).feasible
    assert asked == []
    assert project(3.0 * ROW, _packed(torque), SCALE) is not None
    assert solve(np.zeros(6), row, floor, floor, _packed(torque), SCALE).feasible
    assert asked == [1, 2], "rows and torque limits that PIQP was given"


def _packed(U: Polytope) -> Any:
    """With as many torque limits as joints, which is what can be packed: the others are wide."""
    wide = np.full(5, 1e3)
    return pack(Polytope(U.lower, U.upper, np.eye(6), np.append(U.low, -wide), np.append(U.high, wide)))


def test_a_control_that_is_possible_is_its_own_projection() -> None:
    u = 0.3 * FREE
    assert project(u, pack(box(-FREE, FREE)), SCALE) is u


def _fits(answer: Any, U: Polytope) -> bool:
    inside = np.all(np.abs(answer.u) <= U.upper) and abs(answer.u[5]) <= U.high[5]
    return bool(answer.solved and inside)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_row_without_a_finite_floor_is_not_solved(wrong: float) -> None:
    floor = np.array([-9.0, wrong])
    found = solve(np.zeros(6), np.array([ROW, OTHER]), floor, floor, pack(box(-FREE, FREE)), SCALE)
    assert not found.feasible and found.filtered and found.share == 0.0


@pytest.mark.parametrize("shared", [False, True])
def test_one_row_in_closed_form_is_what_piqp_says(shared: bool) -> None:
    """Also with a share, with bounds that the reference is outside of, and with joints that the row does not feel."""
    rng, solved = np.random.default_rng(4), 0
    for u_ref, C, floor, lower, upper in problems(600, seed=3, rows=1):
        C[0, rng.random(6) < 0.3] = 0.0
        reference = u_ref * rng.choice((0.2, 3.0))
        base = floor - rng.uniform(0.0, 20.0)
        program = safe_control._program(
            reference, C, floor, base, np.zeros(1, np.int64), pack(box(lower, upper)), SCALE, shared
        )
        P, c, G, low, _, least, most = program
        x, is_solved = safe_control._of_one_row(P, c, G, low, least, most)
        y, is_piqps, _ = safe_control._of_piqp(*program)
        room = float(np.maximum(G[0] * least, G[0] * most).sum() - low[0])
        if abs(room) < 1e-4:
            continue
        assert is_solved == is_piqps == (room > 0.0)
        if is_solved:
            solved += 1
            assert np.all((least <= x) & (x <= most)) and G[0] @ x >= low[0] - 1e-9
            np.testing.assert_allclose(x, y, atol=1e-3)  # as exact as PIQP is; the cost says which is better
            cost, other = (float(0.5 * v @ P @ v + c @ v) for v in (x, y))
            assert cost <= other + 1e-6 * max(1.0, abs(other))
    assert solved > 200


def test_joints_that_the_row_does_not_feel_stay_where_they_are_wanted() -> None:
    g, low, ends = np.array([[1.0, 0.0, 2.0]]), np.array([2.5]), np.ones(3)
    with np.errstate(all="raise"):
        x, solved = safe_control._of_one_row(np.eye(3), np.array([-0.2, -0.3, -0.9]), g, low, -ends, ends)
    assert solved
    np.testing.assert_allclose(x, [0.5, 0.3, 1.0], atol=1e-12)
