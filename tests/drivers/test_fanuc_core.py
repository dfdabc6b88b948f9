"""The real core streams to the strict robot in lockstep: no offence, no alarm, at every cycle time, on both wires."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from asc_rt.config import load_cell
from asc_rt.core.fusion import heard
from asc_rt.core.step import step
from asc_rt.core.system import System, initial
from asc_rt.core.types import (
    CycleInputs,
    EventKind,
    Goal,
    Health,
    HumanState,
    Mode,
    OperatorEvent,
    StopReason,
    vector,
)
from asc_rt.core.warm import warm_up
from asc_rt.robot_limits import within
from drivers.base import ProtocolError
from drivers.fanuc_stream_motion.link import StreamMotion
from drivers.fanuc_stream_motion.link_b import StreamMotionB
from drivers.fanuc_stream_motion.session import Session
from sim_hil.fanuc.arm import KinematicPlant
from sim_hil.fanuc.cabinet import Cabinet
from sim_hil.fanuc.controller import Controller
from sim_hil.fanuc.controller_b import ControllerB
from sim_hil.fanuc.lockstep import Lockstep, RmiLine
from sim_hil.fanuc.rmi import RmiServer
from sim_hil.fanuc.settings import Settings

FAR = np.full((1, 3), 50.0)  # m
SWAY = 0.35  # m, how far the person walks to and fro
SHIFTS = [
    ("fanuc-sim-truth", 8, 3, 75_000),
    ("fanuc-sim-truth", 4, 3, 150_000),
    ("fanuc-sim-truth", 2, 3, 300_000),
]  # 600 s each
SHIFT = [pytest.mark.slow, pytest.mark.timeout(3600)]


class Cell:
    """Core, driver, robot; random goals; a person who walks to and fro beside the arm."""

    def __init__(self, name: str, period_ms: int, version: int = 3, told: bool = True, **options: Any) -> None:
        cell = load_cell(name, [f"period_ms={period_ms}"])
        table = {k: v for k, v in cell.sim["fanuc"].items() if k != "faults"}
        settings = Settings.parse({**table, "period_ms": float(period_ms), "limits": True})
        plant = KinematicPlant(np.radians(settings.start_deg), settings.period)
        self.robot: Cabinet
        self.driver: Session
        if name == "crx-sim":
            self.robot = controller = ControllerB(plant, settings)
            self.link = Lockstep(controller)
            line = RmiLine(self.link, RmiServer(controller, 16002))
            options = {"host": "robot", "limits": True, "arm": "crx_10ia_l", "settle": 0.1, **options}
            self.driver = StreamMotionB(options, transport=self.link, line=line)
        else:
            self.robot = Controller(plant, settings)
            self.link = Lockstep(self.robot)
            options = {"host": "robot", "limits": True, "arm": "lrmate_200id", "version": version, **options}
            self.driver = StreamMotion(options, transport=self.link)
        limits = self.driver.configure().limits
        self.system = System(within(cell.params, limits) if told else cell.params)
        self.driver.activate(cell.params.period_ns)
        self.state = initial(self.system)
        self.random = np.random.default_rng(7)
        self.goal: Goal | None = None
        self.reached = 0
        self.stops: list[StopReason] = []

    def run(self, cycles: int) -> None:
        for tick in range(cycles):
            x = self.inputs(tick, cycles)
            mode = self.state.mode
            self.state, out = step(self.system, self.state, x)
            if self.state.mode is Mode.STOPPING and mode is Mode.ACTIVE:
                self.stops.append(self.state.reason)
            if out.command is not None:
                assert self.driver.write(out.command).ok
            if self.state.mode.is_over:
                break

    def inputs(self, tick: int, cycles: int) -> CycleInputs:
        """A stop by the operator now and then, an arming after it; new goals, some before the old one is reached."""
        p = self.system.params
        if self.goal is None or self.state.reached_id == self.goal.id or tick % round(3.0 / p.period) == 0:
            self.reached += self.goal is not None and self.state.reached_id == self.goal.id
            low, high = np.array(p.robot.q_min), np.array(p.robot.q_max)
            q = np.clip(np.radians([0, 0, 10, 0, -80, 0]) + self.random.uniform(-1.0, 1.0, 6), 0.9 * low, 0.9 * high)
            self.goal = Goal(tick + 1, vector(q))
        kind = EventKind.STOP if tick % 700 == 699 else EventKind.END if tick == cycles - 400 else EventKind.ARM
        events = (OperatorEvent(tick + 1, kind),) if tick and (tick % 60 == 5 or kind is not EventKind.ARM) else ()
        joint = self.driver.read(self.link.now_ns() + 3 * p.period_ns)
        now = self.link.now_ns()
        return CycleInputs(
            tick, now, p.period_ns, joint, (seen := person(now)), 0, heard(seen, 0), self.goal, events, 0, False
        )


def person(now_ns: int) -> HumanState:
    t = now_ns * 1e-9
    at = np.array([[1.1 + SWAY * np.sin(0.8 * t), 0.6 * np.sin(0.5 * t), 0.2]])
    v = np.array([[SWAY * 0.8 * np.cos(0.8 * t), 0.3 * np.cos(0.5 * t), 0.0]])
    one = np.ones(1)
    return HumanState(
        now_ns, now_ns, 1, 0, Health.OK, 1.0, False, at, at + [0, 0, 0.6], v, v, 0.1 * one, 0.02 * one, 0.3 * one,
        np.zeros(1, dtype=np.int64),
    )  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _warm() -> None:
    warm_up(System(load_cell("fanuc-sim-truth").params))


@pytest.mark.parametrize(
    ("name", "period_ms", "version", "cycles"),
    [
        ("fanuc-sim-truth", 8, 3, 2000),
        ("fanuc-sim-truth", 8, 1, 1500),
        ("fanuc-sim-truth", 4, 3, 2000),
        ("fanuc-sim-truth", 2, 2, 2500),
        ("crx-sim", 8, 3, 1500),
        ("crx-sim", 4, 3, 2000),
        *(pytest.param(*shift, marks=SHIFT) for shift in SHIFTS),
    ],
)
def test_thousands_of_cycles_without_an_offence(name: str, period_ms: int, version: int, cycles: int) -> None:
    cell = Cell(name, period_ms, version)
    cell.run(cycles)
    cell.driver.close()
    assert [offence.rule for offence in cell.robot.offences] == []
    assert cell.robot.alarms == []
    assert cell.state.mode is Mode.ENDED and cell.driver.fault is None
    assert cell.reached > 0 and StopReason.OPERATOR_STOP in cell.stops
    assert getattr(cell.robot, "over_limit", 0) == 0 and getattr(cell.robot, "silent_stops", 0) == 0
    assert cell.driver.counters.missing == cell.driver.counters.stale == 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "first_stage"), [("fanuc-sim-truth", 0.2), ("crx-sim", 0.1)])
def test_one_box_for_all_flange_speeds_costs_hardly_any_goals(name: str, first_stage: float) -> None:
    """Against limits of the first stage, which no scheme that follows the flange speed can exceed."""
    (box, box_speed), (best, _) = goals_a_minute(name, 0.0), goals_a_minute(name, first_stage)
    print(f"{name}: {box:.2f} goals a minute, {best:.2f} with the first stage's limits, flange {box_speed:.2f} m/s")
    assert box > 0.95 * best


def goals_a_minute(name: str, flange_speed: float, goals: int = 24) -> tuple[float, float]:
    """With nobody there, and the greatest flange speed [m/s]; limits up to `flange_speed`, which nobody checks."""
    cell = Cell(name, 8, flange_speed=flange_speed)
    cell.driver._guard._check = None
    cell.robot.settings = dataclasses.replace(cell.robot.settings, limits=False)
    arm, places, tick = cell.driver._guard._arm, [], 0
    wanted = load_cell(name).goals
    for number in range(goals):
        goal = Goal(number + 1, vector(wanted[number % len(wanted)]))
        while cell.state.reached_id < goal.id:
            joint = cell.driver.read(cell.link.now_ns() + 24_000_000)
            events = (OperatorEvent(tick + 1, EventKind.ARM),)
            now = cell.link.now_ns()
            nobody = dataclasses.replace(person(now), p0=FAR, p1=FAR)
            x = CycleInputs(tick, now, 8_000_000, joint, nobody, 0, heard(nobody, 0), goal, events, 0, False)
            cell.state, out = step(cell.system, cell.state, x)
            assert out.command is not None
            cell.driver.write(out.command)
            places.append(arm.place(cell.state.q_cmd))
            tick += 1
    return 60.0 * goals / (tick * 0.008), float(np.linalg.norm(np.diff(places, axis=0), axis=1).max() / 0.008)


def test_the_profile_alone_does_not_fit_both_conventions_of_j3_and_the_driver_says_so_before_it_sends() -> None:
    cell = Cell("fanuc-sim-truth", 8, told=False)
    with pytest.raises(ProtocolError, match="J3 jerk"):
        cell.run(3000)
    cell.driver.close()
    assert cell.robot.alarms == [] and cell.robot.offences == []
