"""Trials with tools that are swapped: what is drawn, what each policy is told, and what the suite asks for."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asc_rt.config import ConfigError, load_arm
from asc_rt.core.params import STAND_IN
from asc_rt.core.system import initial
from asc_rt.core.types import CycleInputs, EventKind, JointState, Mode, RobotFlag, vector
from logs.audit import audit
from sim_hil import swap_picture
from sim_hil.person import Person
from sim_hil.plant import MujocoPlant
from sim_hil.trials import episode, file_trials, report, suites
from sim_hil.trials.cell_systems import NOBODY_KNOWS, CellSystem
from sim_hil.trials.judge import Outcome
from sim_hil.trials.sensing import Ball, Blind, Perfect
from sim_hil.trials.suite_files import FOLDER, load
from sim_hil.trials.suites import Job
from sim_hil.trials.swapping import Monitor, Stands, Swaps, workplace
from sim_hil.trials.tasks import Shift

SWAPPED = CellSystem("fanuc-tools", ("drill", "bat", "bare"))
STANDING = Person(1).at(3.0)
FILE = FOLDER / "tool-swap.toml"


def short(tmp_path: Path, *changes: tuple[str, str]) -> str:
    text = FILE.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "short.toml"
    path.write_text(text)
    return str(path)


def test_a_suite_is_a_file() -> None:
    suite = suites.find("tool-swap")
    assert [s.name for s in suite.systems] == [
        f"fanuc-tools+{tools}" for tools in ("drill", "bat", "bare", "drill+bat+bare")
    ]
    assert suite.policies == ("asc", "enclosing-sphere", "ssm-stop", "none")
    with pytest.raises(KeyError):
        suites.find("no-such-suite")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("seconds = 6.0", "seconds = 0", "seconds: 0 is out of range; a number from 1 to 3600"),
        ('"stands"', '"leaves"', "person: leaves is not possible; one of stands, visits, roams or live"),
        ('"stands"', '"live"', "person: nobody is live in simulation"),
        ('tools = ["bat"]', 'tools = ["bta"]', "systems[1]: tools: 'bta' is not mounted in cell fanuc-tools"),
        ('tools = ["bat"]', "tools = []", "systems[1].tools: 0 values; a list, each a text"),
        ('cell = "fanuc-tools"', 'cell = "fanuc-tool"', "systems[0]: cell 'fanuc-tool': unknown; did you mean"),
        ('cell = "fanuc-tools"', 'cell = "crx-sim"', "tools: nobody tells a swap in cell crx-sim"),
        (
            'tools = ["bat"]',
            'tools = ["bat"]\ngoals_deg = [[0, 0]]',
            "systems[1]: goals_deg: 2 angles; lrmate_200id has",
        ),
        (
            'person = "stands"',
            'person = "stands"\nset = ["monitor.enfrce=true"]',
            "monitor.enfrce: unknown key; did you mean",
        ),
        ('person = "stands"', "", "person: missing; one of stands, visits, roams, live"),
        ('"none"]', '"nothing"]', "policies[3]: nothing is not possible"),
        ("[seen]", "[sen]", "sen: unknown key; did you mean 'seen'?"),
        ("[seen]", "[seen", "malformed TOML"),
    ],
)
def test_a_fault_of_a_suite_is_one_line(tmp_path: Path, old: str, new: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        suites.find(short(tmp_path, (old, new)))
    assert any(line in found for found in caught.value.lines), caught.value.lines
    assert all("\n" not in found for found in caught.value.lines)


def test_two_faults_are_two_lines(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load(Path(short(tmp_path, ("trials = 100", "trials = 0"), ("clearance_m = 0.3", "clearance_m = -1"))))
    assert len(caught.value.lines) == 2


def plant_of(tool: str) -> MujocoPlant:
    plant = MujocoPlant(SWAPPED.params().holding(0), SWAPPED.goals[0])
    plant.carry(load_arm("lrmate_200id", tool)[1])
    return plant


def test_a_person_stands_still_near_goals_that_are_free_of_them() -> None:
    place = workplace(np.random.default_rng(3), [plant_of("bat")], plant_of("bat"), SWAPPED.goals, 0.3, 0.3, 0.2, 0.25)
    assert place.person.at(0.0) is place.person.at(9.0)
    assert not place.person.at(0.0).v0.any()
    check, room, of_tool = plant_of("bat"), [], []
    for q in (SWAPPED.goals[0], *place.goals):
        check.reset(q)
        check.set_person(place.person.at(0.0))
        room.append(check.distance().distance)
        of_tool.append(check.tool_distance())
    assert room[0] >= 0.3
    assert 2 <= len(place.goals) <= 4
    assert min(room[1:]) >= 0.2
    assert min(of_tool[1:]) <= 0.25
    for seed in range(4):
        near = workplace(np.random.default_rng(seed), [check], check, SWAPPED.goals, 0.3, 0.3, 0.2, 0.22)
        assert min(distance(check, q, near.person) for q in near.goals) <= 0.22
    with pytest.raises(RuntimeError, match="none of 200 people"):
        workplace(np.random.default_rng(3), [plant_of("bat")], plant_of("bat"), SWAPPED.goals, 0.3, 9.0, 0.2, 0.25)


def distance(plant: MujocoPlant, q: np.ndarray, person: Stands) -> float:
    """Of the tool."""
    plant.reset(q)
    plant.set_person(person.at(0.0))
    return plant.tool_distance()


def test_a_classic_stop_keeps_its_distance_where_nobody_looking_does_not(tmp_path: Path) -> None:
    name = short(tmp_path)
    blind, stopped = (suites.run(Job(name, 1, policy, 1, 0)) for policy in ("none", "ssm-stop"))
    assert blind.robot_caused > 0 and blind.tool_distance < 0.1
    assert stopped.robot_caused == 0 and stopped.tool_distance > 0.3


def test_the_operator_of_a_classic_stop_arms_far_from_people_and_stops_near_them() -> None:
    system, n = file_trials._system(SWAPPED), 6
    q = SWAPPED.goals[0]
    at_work = dataclasses.replace(initial(system), mode=Mode.ACTIVE, dq_cmd=vector(np.full(n, 0.5)))
    told: dict[float, list[EventKind]] = {}
    for away in (3.0, 0.5):
        monitor = Monitor(system, Perfect(Ball(np.array([away, -away, 0.3]), 0.1)))
        told[away] = []
        for state in (dataclasses.replace(initial(system), mode=Mode.HOLD), at_work):
            joint = JointState(0, 0, 1, vector(q), state.dq_cmd, system.zero, RobotFlag.READY, 0, False)
            x = CycleInputs(1, 8_000_000, 8_000_000, joint, None, 0, (), None, (), 0, False)
            told[away] += [event.kind for event in monitor.events(state, x)]
    assert told == {3.0: [EventKind.ARM], 0.5: [EventKind.STOP]}


def test_a_swap_keeps_the_motion_and_changes_shape_and_weight() -> None:
    params, home = SWAPPED.params().holding(0), SWAPPED.goals[1]
    plant = MujocoPlant(params, home)
    plant.set_person(STANDING)
    for k in range(20):
        plant.set_target(home + 0.002 * k)
        plant.step()
    q, dq, far = plant.q, plant.dq, plant.tool_distance()
    plant.carry(load_arm("lrmate_200id", "bat")[1])
    np.testing.assert_array_equal(plant.q, q)
    np.testing.assert_array_equal(plant.dq, dq)
    alone = MujocoPlant(dataclasses.replace(params, tool=load_arm("lrmate_200id", "bat")[1]), q)
    alone.set_person(STANDING)
    assert plant.tool_distance() == pytest.approx(alone.tool_distance(), abs=1e-9)
    assert plant.tool_distance() != pytest.approx(far, abs=0.01)
    assert plant.tool == "bat"


def test_the_tools_distance_is_its_own_and_of_a_bare_flange_the_last_links() -> None:
    for tool, parts in (("drill", {"tool0", "tool1"}), ("bat", {"tool0", "tool1"}), ("bare", {"j6"})):
        plant = plant_of(tool)
        ball = plant.distance()  # nobody
        assert ball.distance == plant.tool_distance() == np.inf
        plant.set_person(Stands(1).at(0.0))
        assert plant.tool_distance() >= plant.distance().distance
        assert plant.tool_distance(plant.distance()) == plant.tool_distance()
        assert {plant._part(int(g)) for g in plant._carried} == parts


def test_a_tool_is_not_mounted_where_a_person_is() -> None:
    plant = MujocoPlant(SWAPPED.params().holding(0), SWAPPED.goals[0])
    plant.set_person(STANDING)
    swaps = Swaps(SWAPPED.mounts(), [1.0, 2.0], clearance=0.0)
    assert [swaps.number(t, plant) for t in (0.9, 1.0, 1.9, 2.0, 9.0)] == [1, 2, 2, 0, 0]
    plant.carry(SWAPPED.mounts()[0][1])
    assert Swaps(SWAPPED.mounts(), [1.0, 2.0], clearance=50.0).number(5.0, plant) == 1
    assert plant.tool == "drill"
    assert Swaps(SWAPPED.mounts(), [1.0, 2.0], 0.0, NOBODY_KNOWS).number(5.0, plant) == NOBODY_KNOWS
    assert plant.tool == "bat"  # whatever is told


def test_what_each_policy_is_told() -> None:
    f = load(FILE)
    setups = {policy: file_trials.setup(f, SWAPPED, policy, 0, 0) for policy in f.policies}
    assert len({id(s.system) for s in setups.values()}) == 1
    assert [m.tool.name for m in setups["asc"].system.params.changer.mounts][-1] == "enclosing-sphere"
    assert setups["asc"].system.params.changer.mounts[-1].number == STAND_IN
    assert all(m.covered for m in setups["asc"].system.params.changer.mounts)
    assert isinstance(setups["none"].sensor, Blind) and isinstance(setups["ssm-stop"].sensor, Blind)
    assert setups["ssm-stop"].operator is not None and setups["asc"].operator is None
    plant = MujocoPlant(SWAPPED.params().holding(0), SWAPPED.goals[0])
    told = {policy: s.changer.number(0.0, plant) for policy, s in setups.items() if s.changer is not None}
    assert told == {"asc": 1, "enclosing-sphere": NOBODY_KNOWS, "ssm-stop": 1, "none": 1}
    at = [s.world.at(0.0) for s in setups.values()]
    assert all(np.array_equal(at[0].p0, other.p0) for other in at[1:])  # the same draws


def test_to_creep_towards_a_goal_is_no_progress() -> None:
    state, q = initial(file_trials._system(SWAPPED)), np.zeros(6)
    task = Shift(np.array([np.zeros(6), np.full(6, 2.0)]), patience=1.5)
    first = task.goal(0.0, state, q).id
    assert task.goal(1.4, state, q + 0.05).id == first
    assert task.goal(1.6, state, q + 0.06).id == first + 1  # 0.04 rad/s
    assert task.goal(1.7, state, np.full(6, 1.0)).id == first + 1
    assert task.goal(3.0, state, np.full(6, 0.8)).id == first + 1  # nearer by 0.2
    assert task.goal(4.4, state, np.full(6, 0.8)).id == first + 1
    assert task.reached(state) == 0


def test_a_swapped_trial_is_the_same_again_and_the_robot_causes_nothing(tmp_path: Path) -> None:
    name = short(tmp_path)
    job = Job(name, 3, "asc", 0, 0)
    first = suites.run(job)
    assert first == suites.run(job, tmp_path)  # and recorded
    found, _ = audit(next(tmp_path.glob("*.mcap")), sample=30)
    told = next(rule for rule in found["rules"] if rule["name"] == "tool")
    assert told["holds"]
    assert told["detail"].startswith("2 swaps: drill to bat at ")
    assert [(swap["from"], swap["to"], swap["missed_ticks"]) for swap in found["swaps"]] == [
        ("drill", "bat", 0),
        ("bat", "bare", 0),
    ]
    assert found["swaps"][0]["dq_max_after"] == pytest.approx(0.5 * found["swaps"][0]["dq_max_before"], abs=1e-3)
    picture = tmp_path / "swaps.png"
    assert swap_picture.main([str(next(tmp_path.glob("*.mcap"))), "-o", str(picture)]) == 0
    assert picture.stat().st_size > 1000
    assert first.tools == ("drill", "bat", "bare")
    assert first.robot_caused == 0
    assert not first.limits_exceeded
    assert first.cycles == round(6.0 / 0.008) - 1
    assert len(first.distances) == 60


@pytest.mark.parametrize("system", [1, 3, 5])
def test_nobody_who_roams_is_harmed_by_the_arm_on_a_trial_of_the_campaign(system: int) -> None:
    outcome = suites.run(Job("campaign", system, "asc", 3, 0))
    assert outcome.robot_caused == 0 and not outcome.limits_exceeded and outcome.reached > 0, outcome.notes


@pytest.mark.parametrize(("system", "trial"), [(0, 166), (0, 334), (1, 944), (1, 1081), (4, 1241)])
def test_a_hand_that_is_faster_than_what_is_known_of_it_finds_an_arm_at_rest(system: int, trial: int) -> None:
    """MEASURED: 32 of 10 000 trials without the protective distance, at up to 0.4 m/s; (0, 166) also with it at
    1.6 m/s of people."""
    suite = suites.find("campaign")
    assert suite.file is not None
    outcome = suites.run(Job("campaign", system, "asc", trial, 1))
    assert outcome.robot_caused == 0 and not outcome.limits_exceeded, outcome.notes
    unenforced = dataclasses.replace(suite.systems[system], overrides=())
    bare = episode.run(file_trials.setup(suite.file, unenforced, "asc", trial, 1))
    assert bare.robot_caused > 0, "these trials show nothing any more: draw others"


def test_a_hand_comes_to_an_arm_that_has_just_started() -> None:
    """MEASURED: an S_p of the measured speed alone stopped it too late, since it was told to go faster already."""
    outcome = suites.run(Job("campaign", 0, "asc", 49, 1))
    assert outcome.robot_caused == 0 and outcome.stops > 0, outcome.notes


def row(policy: str, extra: float, reached: int, seconds: float = 1.0) -> dict[str, object]:
    zero = dict.fromkeys(("robot_caused", "limits_exceeded"), 0)
    paired = {"paired": {"seconds_per_goal": {"median": seconds}}}
    about = {"system": "fanuc-tools+drill", "policy": policy, "trials": 1}
    return {**about, "extra_m": extra, "reached": reached, **zero, **paired}


def test_the_verdict_asks_for_less_distance_and_more_and_faster_goals() -> None:
    ours, sphere = row("asc", 0.1, 9), row("enclosing-sphere", 0.21, 5)
    assert report.holds("tool-swap", [ours, sphere])
    for bad in (
        [row("asc", 0.11, 9), sphere],
        [row("asc", 0.1, 5), sphere],
        [ours, row("enclosing-sphere", 0.21, 5, seconds=-0.1)],
    ):
        assert not report.holds("tool-swap", bad)
        assert len(report.shortfalls("tool-swap", bad)) == 1
    assert not report.holds("tool-swap", [ours | {"robot_caused": 1}, sphere])
    assert not report.holds("tool-swap", [ours | {"limits_exceeded": 1}, sphere])


def test_extra_distance_is_what_the_policy_adds() -> None:
    """To d_min where the work leads there, to where the work is otherwise."""
    number = dict.fromkeys(("violations", "robot_caused", "infeasible", "stops", "filtered"), 0)
    share = dict.fromkeys(("speed_share", "torque_share", "M_min", "M_max", "M_dot_star", "min_distance"), 0.5)
    nothing: dict[str, tuple[str, ...]] = dict.fromkeys(("limits_exceeded", "tools", "notes"), ())
    made = Outcome(6.0, 749, 1, True, end="ACTIVE NONE", tool_distance=0.2, distances=(), **number, **share, **nothing)
    least = {"asc": (0.16, 0.17, 0.3), "enclosing-sphere": (0.3, 0.36, 0.5), "none": (0.02, 0.15, 0.3)}
    done = [
        (Job("tool-swap", 2, policy, k, 0), dataclasses.replace(made, tool_distance=d))
        for policy, distances in least.items()
        for k, d in enumerate(distances)
    ]
    table = {row["policy"]: row for row in report.rows("tool-swap", done)}
    assert {policy: row["extra_m"] for policy, row in table.items()} == pytest.approx(
        {"asc": 0.02, "enclosing-sphere": 0.2, "none": 0.0}
    )
    assert table["asc"]["tool_m"] == 0.17
    alone = [pair for pair in done if pair[0].policy == "asc"]
    assert report.rows("tool-swap", alone)[0]["extra_m"] == pytest.approx(0.07)
