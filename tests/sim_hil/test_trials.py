"""The trials: draws, sensing, judging and the promise itself, in numbers small enough for every run."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import beta

from asc_rt.core.kinematics import forward
from asc_rt.core.system import System, initial
from asc_rt.core.types import CommandKind, JointCommand, vector
from asc_rt.trials import run_trials
from logs.recording import open_recording
from logs.replay import replay
from sim_hil.person import Capsules, Person
from sim_hil.plant import MujocoPlant
from sim_hil.trials import episode, main, report, suites
from sim_hil.trials.episode import Setup
from sim_hil.trials.judge import Judge, Outcome
from sim_hil.trials.planner import Planner
from sim_hil.trials.results import Results
from sim_hil.trials.scenarios import FREE, goal_and_obstacle, rng_of
from sim_hil.trials.sensing import Ball, Blind, Camera
from sim_hil.trials.statistics import paired_events, paired_median, upper_bound
from sim_hil.trials.suites import CAMERA, SUITES, TABLE1, TRANSFER, Job
from sim_hil.trials.tasks import ATTEMPTS, PATIENCE, Rounds, Visit
from sim_hil.trials.transfer import Verdict, verdict

ROOT = Path(__file__).parents[2]
PANDA = TABLE1[2]


@pytest.fixture(scope="module")
def panda() -> System:
    return System(PANDA.params())


@pytest.fixture(scope="module")
def outcomes() -> dict[Job, Outcome]:
    """Two goals of two Pandas with and without the filter."""
    jobs = [Job("table1", i, policy, trial, 0) for i in (0, 2) for policy in suites.POLICIES for trial in range(2)]
    return {job: suites.run(job) for job in jobs}


# --- figures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("events", "trials"), [(0, 1), (0, 100), (1, 20), (7, 30), (19, 20), (0, 10_000)])
def test_the_upper_bound_is_the_exact_one(events: int, trials: int) -> None:
    assert upper_bound(events, trials) == pytest.approx(beta.ppf(0.95, events + 1, trials - events), rel=1e-9)


def test_the_upper_bound_of_certainty_and_of_nonsense() -> None:
    assert upper_bound(5, 5) == 1.0
    for events, trials in [(0, 0), (-1, 5), (6, 5)]:
        with pytest.raises(ValueError, match="trials"):
            upper_bound(events, trials)


def test_paired_events_count_only_the_draws_that_differ() -> None:
    ours, other = [False] * 9 + [True], [True] * 8 + [False, True]
    found = paired_events(ours, other)
    assert found == {"only_asc": 0, "only_other": 8, "p": pytest.approx(2 * 0.5**8)}
    assert paired_events([True, False], [True, False])["p"] == 1.0


def test_paired_medians_are_of_the_differences_not_the_difference_of_medians() -> None:
    found = paired_median([1.0, 2.0, 9.0], [2.0, 4.0, 4.0])
    assert found is not None and found["median"] == 1.0 and found["draws"] == 3
    assert paired_median([1.0, 2.0], [1.0, 2.0]) == {"draws": 2, "median": 0.0, "p": 1.0}
    assert paired_median([], []) is None


# --- sensing ---------------------------------------------------------------------------------------------------------


def test_the_camera_is_late_and_inexact_within_its_stated_bounds() -> None:
    person, camera = Person(3), Camera(Person(3), CAMERA, 3)
    ages, errors, last = [], [], -1
    for t in np.arange(0.2, 6.0, 0.008):
        seen = camera.at(t)
        assert seen is not None
        message, age = seen
        assert message.seq >= last
        assert message.t_capture_ns == pytest.approx((t - age) * 1e9, abs=2)
        truth = person.at(t - age)
        errors.append(np.linalg.norm(message.p0 - truth.p0, axis=1))
        assert np.all(np.linalg.norm(message.p1 - truth.p1, axis=1) <= message.position_bound)
        assert np.all(np.linalg.norm(message.v0 - truth.v0, axis=1) <= message.velocity_bound)
        ages.append(age)
        last = message.seq
    low, high = CAMERA.latency
    assert low <= min(ages) and max(ages) <= high + 1.0 / CAMERA.rate and max(ages) - min(ages) > 0.03
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(CAMERA.position_noise, rel=0.1)


def test_the_camera_says_nothing_before_its_first_frame_has_arrived() -> None:
    assert Camera(Person(3), CAMERA, 3).at(0.05) is None


def test_the_camera_is_a_function_of_seed_and_time() -> None:
    first, second, other = (Camera(Person(3), CAMERA, seed) for seed in (3, 3, 4))
    second.at(2.5)  # asked in another order
    a, b, c = first.at(2.0), second.at(2.0), other.at(2.0)
    assert a and b and c
    assert np.array_equal(a[0].p0, b[0].p0) and a[1] == b[1]
    assert not np.array_equal(a[0].p0, c[0].p0)


# --- draws -----------------------------------------------------------------------------------------------------------


def test_a_draw_is_clear_of_the_obstacle_at_start_and_goal_and_belongs_to_its_seed(panda: System) -> None:
    draws = [goal_and_obstacle(panda, PANDA.home, rng_of(seed, PANDA.name, 5)) for seed in (1, 1, 2)]
    assert np.array_equal(draws[0].q0, draws[1].q0) and np.array_equal(draws[0].ball.centre, draws[1].ball.centre)
    assert not np.array_equal(draws[0].q0, draws[2].q0)
    plant = MujocoPlant(panda.params)
    for draw in draws:
        for q in (draw.q0, draw.goal):
            plant.reset(q)
            plant.set_person(draw.ball.at(0.0))
            assert plant.distance().distance >= PANDA.d_min + FREE


def test_at_least_half_of_the_draws_need_the_filter() -> None:
    runs = [suites.run(Job("table1", 4, "none", trial, 7)) for trial in range(4)]
    assert sum(run.violations > 0 for run in runs) >= 2


# --- the planner and the task ----------------------------------------------------------------------------------------


def test_the_planner_goes_around(panda: System) -> None:
    draw = goal_and_obstacle(panda, PANDA.home, rng_of(0, PANDA.name, 0))
    rng, clearance = np.random.default_rng(1), PANDA.d_min + 0.02
    way = Planner(panda, draw.ball.at(0.0), clearance).plan(draw.q0, draw.goal, rng, 2000)
    assert way is not None and np.array_equal(way[-1], draw.goal) and len(way) > 1
    plant, poses = MujocoPlant(panda.params), [draw.q0, *way]
    nearest = np.inf
    for a, b in zip(poses, poses[1:], strict=False):
        for share in np.linspace(0.0, 1.0, 40):
            plant.reset(a + share * (b - a))
            plant.set_person(draw.ball.at(0.0))
            nearest = min(nearest, plant.distance().distance)
    assert nearest > clearance - 0.005  # poses between the ones that were looked at


def test_the_planner_knows_when_there_is_no_way(panda: System) -> None:
    draw = goal_and_obstacle(panda, PANDA.home, rng_of(0, PANDA.name, 0))
    inside = Ball(last_joint(panda, draw.goal), 0.05)
    assert Planner(panda, inside.at(0.0), 0.07).plan(draw.q0, draw.goal, np.random.default_rng(0), 200) is None


def last_joint(system: System, q: np.ndarray) -> np.ndarray:
    return np.array(forward(system.model.chain, q, np.zeros(system.n)).origin[-1])


class OneVia:
    def __init__(self, via: np.ndarray) -> None:
        self.via, self.asked = via, 0

    def plan(self, start: np.ndarray, goal: np.ndarray, rng: Any, branches: int) -> list[np.ndarray]:
        self.asked += 1
        return [self.via, goal]


def test_a_visit_that_makes_no_progress_goes_by_another_way_and_gives_up_at_last(panda: System) -> None:
    goal, via, q = np.full(7, 0.5), np.full(7, 0.3), np.zeros(7)
    planner = OneVia(via)
    task, state = Visit(goal, planner, np.random.default_rng(0)), initial(panda)  # type: ignore[arg-type]
    assert np.array_equal(task.goal(0.0, state, q).q, goal)
    assert np.array_equal(task.goal(0.9 * PATIENCE, state, q).q, goal)
    asked = task.goal(1.1 * PATIENCE, state, q)
    assert np.array_equal(asked.q, via) and planner.asked == 1
    after = task.goal(1.2 * PATIENCE, state, via)
    assert np.array_equal(after.q, goal) and after.id > asked.id
    assert not task.reached(state)
    assert task.reached(dataclasses.replace(state, reached_id=after.id))
    for i in range(3, 10 * ATTEMPTS):
        task.goal(i * PATIENCE, state, q)
    assert planner.asked == ATTEMPTS and task.is_over


# --- lockstep --------------------------------------------------------------------------------------------------------


class Recorder:
    """A plant that only notes what it is told."""

    def __init__(self, n: int) -> None:
        self.q, self.targets = np.zeros(n), []

    def set_target(self, q: np.ndarray) -> None:
        self.targets.append(float(q[0]))


def test_a_set_point_arrives_one_command_latency_late() -> None:
    system = System(TRANSFER[6].params())  # LR Mate: 60 ms, 7.5 periods
    plant = Recorder(system.n)
    arm = episode.Arm(plant, system)  # type: ignore[arg-type]
    for k in range(12):
        q = vector(np.full(system.n, float(k)))
        arm.send(JointCommand(k, CommandKind.POSITION, q, q, q, False))
    assert plant.targets[-1] == 11 - 7.5


class Approaching:
    """A ball that comes along x and is at `end` after a second."""

    def __init__(self, end: np.ndarray) -> None:
        self.end = end

    def at(self, t: float) -> Capsules:
        point = self.end[None] + [[1.0 - min(t, 1.0), 0.0, 0.0]]
        velocity = np.array([[-1.0 if t < 1.0 else 0.0, 0.0, 0.0]])
        return Capsules(("ball",), point, point, np.array([0.02]), velocity, velocity)


def test_who_walks_into_an_arm_at_rest_is_not_the_arms_doing(panda: System) -> None:
    world = Approaching(last_joint(panda, PANDA.home))
    setup = Setup(panda, PANDA.home, world, Blind(), Rounds(PANDA.home[None]), 1.2, True, ends_at_contact=False)
    outcome = episode.run(setup)
    assert outcome.violations == 1 and outcome.robot_caused == 0 and outcome.min_distance < PANDA.d_min


def test_an_arm_that_moves_towards_somebody_inside_d_min_is_guilty_once(panda: System) -> None:
    plant = MujocoPlant(panda.params, PANDA.home)
    judge = Judge(panda, plant)
    plant.set_person(Ball(last_joint(panda, PANDA.home) + [0.0, 0.0, -0.17], 0.02).at(0.0))  # under the hand
    judge.look(0.0)
    assert judge.robot_caused == 0
    for i in range(60):  # no torque: it falls
        plant.set_torque(np.zeros(7))
        plant.step()
        judge.look(i * 0.001)
    assert judge.violations == 1 and judge.robot_caused == 1


def test_a_limit_that_the_arm_exceeds_is_told(panda: System) -> None:
    plant = MujocoPlant(panda.params, PANDA.home)
    judge = Judge(panda, plant)
    plant.set_person(Ball(np.array([0.0, 0.0, 5.0]), 0.02).at(0.0))
    for _ in range(400):
        plant.set_torque(np.array([87.0, 0, 0, 0, 0, 0, 0]))
        plant.step()
        judge.look(0.0)
    found = judge.outcome(0.4, 400, initial(panda), 0, True)
    assert "velocity" in found.limits_exceeded and found.speed_share > 1.0


# --- the promise -----------------------------------------------------------------------------------------------------


def test_the_filter_keeps_its_distance_and_its_limits_and_still_gets_there(outcomes: dict[Job, Outcome]) -> None:
    for job, outcome in outcomes.items():
        if job.policy == "asc":
            assert outcome.violations == outcome.infeasible == outcome.stops == 0, outcome
            assert outcome.limits_exceeded == () and outcome.reached == 1, outcome
            assert outcome.filtered > 0 and outcome.min_distance >= PANDA.d_min, outcome


def test_without_the_filter_the_same_draws_end_inside(outcomes: dict[Job, Outcome]) -> None:
    unfiltered = [outcome for job, outcome in outcomes.items() if job.policy == "none"]
    assert sum(o.robot_caused > 0 for o in unfiltered) >= len(unfiltered) / 2
    assert all(o.filtered == 0 and o.limits_exceeded == () for o in unfiltered)


def test_a_trial_is_a_function_of_its_job(outcomes: dict[Job, Outcome]) -> None:
    job = min((job for job in outcomes if job.policy == "asc"), key=lambda job: outcomes[job].cycles)
    assert suites.run(job) == outcomes[job]


def test_an_index_made_for_a_panda_holds_on_an_arm_that_takes_positions() -> None:
    i = next(i for i, system in enumerate(TRANSFER) if system.name == "lrmate_200id+drill")
    outcome = suites.run(Job("transfer", i, "asc", 0, 0))
    assert outcome.violations == 0 and outcome.limits_exceeded == () and outcome.reached == 1, outcome


def test_rows_count_trials_and_the_promise_is_judged_on_them(outcomes: dict[Job, Outcome]) -> None:
    table = report.rows("table1", outcomes.items())
    assert [(row["system"], row["policy"]) for row in table] == [
        (name, policy) for name in ("panda_5dof+ee1", "panda+ee1") for policy in ("asc", "none")
    ]
    needed = {"trials", "violations", "robot_caused", "infeasible", "reached", "min_distance_m", "M_min", "M_max"}
    assert all(needed | {"M_dot_star", "k"} <= row.keys() and row["trials"] == 2 for row in table)
    assert report.holds("table1", table)
    for key in ("violations", "robot_caused", "infeasible", "limits_exceeded"):
        assert not report.holds("table1", [{**table[0], key: 1}]), key
    assert report.holds("moving-human", [{**table[0], "violations": 1}])  # somebody walked into an arm at rest
    assert not report.holds("moving-human", [{**table[0], "robot_caused": 1}])


# --- the command -----------------------------------------------------------------------------------------------------


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "sim_hil", "trials", *arguments]


def test_a_moving_person_is_never_approached_inside_d_min_and_the_command_says_so(tmp_path: Path) -> None:
    done = subprocess.run(
        command("moving-human", "-n", "1", "-j", "1", "--json", "-o", str(tmp_path)),
        capture_output=True, text=True, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    filtered, blind = result["rows"]
    assert (filtered["policy"], blind["policy"]) == ("asc", "none")
    assert filtered["robot_caused"] == filtered["limits_exceeded"] == 0 and filtered["reached"] > 5
    assert blind["robot_caused"] == 1
    assert filtered["needed"] == 1.0 and blind["paired"]["robot_caused"]["only_other"] == 1
    table = pq.read_table(result["logs"][1]).to_pylist()
    assert [(row["policy"], row["trial"], row["robot_caused"]) for row in table] == [("asc", 0, 0), ("none", 0, 1)]
    assert "2 of 2 trials" in done.stderr


def run_command(*arguments: str) -> tuple[int, dict[str, Any], str]:
    done = subprocess.run(command(*arguments, "--json", "-j", "1"), capture_output=True, text=True, cwd=ROOT)
    return done.returncode, json.loads(done.stdout.splitlines()[-1]) if done.stdout else {}, done.stderr


def test_a_campaign_is_gone_on_with_and_other_trials_are_kept_out(tmp_path: Path) -> None:
    few = ("table1", "--policy", "none", "--system", "panda_5dof+ee1", "-o", str(tmp_path))
    code, first, _ = run_command(*few, "-n", "1")
    assert (code, first["rows"][0]["trials"]) == (0, 1)
    journal = tmp_path / "table1.jsonl"
    before = journal.read_text()
    journal.write_text(before + '{"suite": "table1", "sys')  # killed while it wrote
    code, second, told = run_command(*few, "-n", "2")
    assert (code, second["rows"][0]["trials"], second["complete"]) == (0, 2, True)
    assert "1 of 2 trials were done before" in told and journal.read_text().startswith(before)
    assert pq.read_table(tmp_path / "table1.parquet").num_rows == 2
    code, _, told = run_command(*few, "-n", "2", "--seed", "1")
    assert code == 2 and "seed" in told and len(told.splitlines()) == 1


def test_results_come_back_as_they_were(tmp_path: Path, outcomes: dict[Job, Outcome]) -> None:
    results = Results(tmp_path, "table1", 0)
    for pair in outcomes.items():
        results.add(*pair)
    assert Results(tmp_path, "table1", 0).done == list(outcomes.items())


def test_a_killed_campaign_loses_only_what_was_running(tmp_path: Path) -> None:
    arguments = ("table1", "-n", "40", "-j", "1", "--policy", "none", "--system", "panda_5dof+ee1", "-o", str(tmp_path))
    run = subprocess.Popen(command(*arguments), cwd=ROOT, stderr=subprocess.DEVNULL)
    journal = tmp_path / "table1.jsonl"
    while run.poll() is None and (not journal.exists() or journal.read_text().count("\n") < 3):
        time.sleep(0.02)
    run.kill()
    run.wait()
    assert len(Results(tmp_path, "table1", 0).done) >= 2


def test_one_trial_is_run_again_and_recorded_for_view_and_replay(tmp_path: Path) -> None:
    one = ("--system", "lrmate_200id+drill", "--policy", "asc", "--trial", "3", "--record", "-o", str(tmp_path))
    assert run_command("transfer", *one)[0] == 0
    log = open_recording(tmp_path / "transfer-lrmate_200id+drill-asc-0-3.mcap")
    report = replay(log)
    assert report.exact and report.mismatches == 0 and report.cycles > 100
    assert len(list(log.messages("/sim/truth"))) == report.cycles


def test_a_dask_cluster_runs_the_same_trials() -> None:
    from distributed import LocalCluster

    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with LocalCluster(**options, protocol="tcp", host="127.0.0.1") as scheduler:
        one = ("--policy", "none", "--system", "panda_5dof+ee1", "-n", "1")
        code, there, told = run_command("table1", *one, "--cluster", scheduler.scheduler_address)
    assert code == 0, told
    assert {**there, "seconds": 0} == {**run_command("table1", *one)[1], "seconds": 0}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["tabel1"], "table1"),
        (["table1", "-n", "0"], "1 or more"),
        (["table1", "--seed", "-3"], "0 or more"),
        (["table1", "--trial", "-3"], "0 or more"),
        (["table1", "--system", "pandas"], "panda_5dof+ee1"),
        (["table1", "--policy", "best"], "asc, none"),
        (["table1", "--record"], "-o DIR"),
        (["table1", "--cluster", "127.0.0.1:1"], "no Dask scheduler"),
        (["table1", "-o", "/dev/null/x"], "/dev/null/x"),
        ([], "SUITE"),
    ],
)
def test_bad_usage_is_one_line(
    arguments: list[str], says: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the command's, not the test's
    try:
        code = main.main(arguments)
    except SystemExit as end:
        code = end.code
    assert code == 2
    out, err = capfd.readouterr()
    assert out == "" and says in err and len(err.splitlines()) == 1


def test_the_command_line_hands_over_to_the_simulators_process(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_trials(["tabel1"]) == 2
    assert "table1" in capfd.readouterr().err


def test_a_killed_run_leaves_no_worker_behind() -> None:
    run = subprocess.Popen(
        command("table1", "-n", "50", "-j", "1"), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    workers: set[int] = set()
    while not workers and run.poll() is None:
        workers = {pid for pid in children(run.pid) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()}
        time.sleep(0.05)
    time.sleep(3.0)  # until it has set itself up
    run.kill()
    run.wait()
    for _ in range(100):
        if not any(is_alive(pid) for pid in workers):
            break
        time.sleep(0.1)
    left = [pid for pid in workers if is_alive(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert workers and not left


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.timeout(4 * 3600)
@pytest.mark.parametrize("suite", list(SUITES))
def test_the_whole_suite_keeps_the_promise(suite: str) -> None:
    assert subprocess.run(command(suite, "--json"), cwd=ROOT).returncode == 0


# --- transfer --------------------------------------------------------------------------------------------------------


def test_the_index_is_covered_where_the_states_on_its_surface_have_a_control_and_refused_elsewhere() -> None:
    own = verdict(TRANSFER[0], 30_000)
    assert own.is_covered and own.boundary_states == own.feasible > 10_000 and own.M_min > 0.0
    refused = verdict(next(s for s in TRANSFER if s.name == "lrmate_200id+drill"), 30_000)
    assert not refused.is_covered and refused.feasible < refused.boundary_states
    assert "states on phi = 0 have no control within the real limits" in refused.reasons[0]


def test_nothing_is_promised_where_the_index_does_not_cover_the_system(
    outcomes: dict[Job, Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = dataclasses.replace(next(iter(outcomes.values())), violations=1, robot_caused=1)
    for reasons, promised in (((), True), (("7 of 9 states",), False)):
        monkeypatch.setattr(report, "verdict", lambda _, r=reasons: Verdict(9, 2, -1.0, r))
        done = [(Job("transfer", 4, "asc", 0, 0), bad)]
        (row,) = report.rows("transfer", done)
        assert (row["covered"], row["refused"]) == (promised, list(reasons))
        assert (row["boundary_states"], row["boundary_feasible"], row["robot_caused"]) == (9, 2, 1)
        assert report.holds("transfer", [row]) is not promised
        assert bool(report.broken_promises(done)) is promised
