"""What happened in an episode, judged by MuJoCo's geometry and state, never by the controller's own kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asc_rt.core.system import System
from asc_rt.core.types import Basis, CoreState, CycleOutputs, Mode, Status
from sim_hil.plant import MujocoPlant

APPROACHING = 0.01  # m/s: a robot slower than this does not approach
PROFILE_S = 0.1  # s between the distances that are kept
FAR = 9.99  # m: nobody is there
TOLERANCE = 1e-6  # of a limit, for rounding


@dataclass(frozen=True, slots=True)
class Outcome:
    seconds: float  # simulated
    cycles: int
    reached: int  # goals
    reachable: bool  # a way exists, as far as the planner could tell
    min_distance: float  # m, robot to person or obstacle
    violations: int  # times that the robot got, or was, inside d_min
    robot_caused: int  # times inside d_min with the robot's nearest point still approaching
    infeasible: int  # cycles
    stops: int  # protective stops
    filtered: int  # cycles in which a row moved the reference
    limits_exceeded: tuple[str, ...]
    speed_share: float  # largest share of a velocity limit
    torque_share: float
    M_min: float  # m/s2, over all active pairs met
    M_max: float
    M_dot_star: float  # m/s3, fastest fall of M met
    end: str  # mode and reason at the end
    tool_distance: float  # m, least, of what the arm carries (its last link, if nothing) to person or obstacle
    distances: tuple[float, ...]  # m, the same every PROFILE_S
    tools: tuple[str, ...]  # that it carried, one after the other
    notes: tuple[str, ...]  # each robot-caused event, stop and fault, with its time


class Judge:
    def __init__(self, system: System, plant: MujocoPlant) -> None:
        self._system, self._plant = system, plant
        self._distances: list[float] = []
        self._tools: list[str] = [plant.tool]
        self._effort = np.array(system.params.robot.effort or ())
        self._inside = self._guilty = False
        self._exceeded: set[str] = set()
        self._notes: list[str] = []
        self.min_distance = self._tool_distance = np.inf
        self.violations = self.robot_caused = self.infeasible = self.stops = self.filtered = 0
        self._speed = self._torque = 0.0
        self._M = [np.inf, -np.inf]
        self._fall = 0.0

    def look(self, t: float) -> None:
        """At the true state: distance, approach, limits."""
        d_min, b = self._system.params.safety.d_min, self._system.bounds
        nearest = self._plant.distance(approach_within=d_min)
        self.min_distance = min(self.min_distance, nearest.distance)
        of_tool = self._plant.tool_distance(nearest)
        self._tool_distance = min(self._tool_distance, of_tool)
        if t >= PROFILE_S * len(self._distances):
            self._distances.append(round(min(of_tool, FAR), 4))
        if self._plant.tool != self._tools[-1]:
            self._tools.append(self._plant.tool)
            self._notes.append(f"{t:.3f} s carries {self._plant.tool}, {nearest.distance * 1e3:.0f} mm away")
        inside = nearest.distance < d_min
        guilty = inside and nearest.approach > APPROACHING
        self.violations += inside and not self._inside
        if guilty and not self._guilty:
            self.robot_caused += 1
            where = f"{nearest.robot_part} to {nearest.person_part} {nearest.distance * 1e3:.1f} mm"
            self._notes.append(f"{t:.3f} s robot-caused: {where}, approaching at {nearest.approach:.3f} m/s")
        self._inside, self._guilty = inside, guilty
        q, speed = self._plant.q, float(np.max(np.abs(self._plant.dq) / b.dq_max))
        self._speed = max(self._speed, speed)
        if np.any(q < b.q_min - TOLERANCE) or np.any(q > b.q_max + TOLERANCE):
            self._exceeded.add("position")
        if speed > 1.0 + TOLERANCE:
            self._exceeded.add("velocity")
        if len(self._effort):
            share = float(np.max(np.abs(self._plant.torque) / self._effort))
            self._torque = max(self._torque, share)
            if share > 1.0 + TOLERANCE:
                self._exceeded.add("torque")

    def note(self, t: float, before: CoreState, after: CoreState, out: CycleOutputs) -> None:
        """What the controller says of its own cycle."""
        decision, pairs = out.decision, out.decision.pairs
        self.infeasible += decision.status is Status.INFEASIBLE
        self.filtered += decision.status is Status.FILTERED
        if before.mode is Mode.ACTIVE and after.mode is not Mode.ACTIVE:
            self.stops += 1
            self._notes.append(f"{t:.3f} s {after.mode.name} {after.reason.name}")
        evaluated = pairs.basis != Basis.FREE
        if after.mode is Mode.ACTIVE and np.any(evaluated):
            M, fall = pairs.M[evaluated], -pairs.M_dot[evaluated]
            self._M = [min(self._M[0], float(M.min())), max(self._M[1], float(M.max()))]
            self._fall = max(self._fall, float(fall.max()))

    def outcome(self, t: float, cycles: int, state: CoreState, reached: int, reachable: bool) -> Outcome:
        return Outcome(
            seconds=t,
            cycles=cycles,
            reached=reached,
            reachable=reachable,
            min_distance=float(self.min_distance),
            violations=self.violations,
            robot_caused=self.robot_caused,
            infeasible=self.infeasible,
            stops=self.stops,
            filtered=self.filtered,
            limits_exceeded=tuple(sorted(self._exceeded)),
            speed_share=self._speed,
            torque_share=self._torque,
            M_min=self._M[0],
            M_max=self._M[1],
            M_dot_star=self._fall,
            end=f"{state.mode.name} {state.reason.name}",
            tool_distance=float(self._tool_distance),
            distances=tuple(self._distances),
            tools=tuple(self._tools),
            notes=tuple(self._notes),
        )
