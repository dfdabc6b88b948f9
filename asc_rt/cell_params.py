"""The files of a cell as parameters: degrees, milliseconds, kilograms become SI and radians here and nowhere else."""

from __future__ import annotations

import math
from collections.abc import Sequence

from asc_rt.cell_files import Capsule, CellFile, Human, ProfileFile, Safety, ToolFile
from asc_rt.core.params import (
    CapsuleSpec,
    HumanParams,
    MonitorParams,
    Params,
    RobotParams,
    SafetyParams,
    SensorParams,
    TaskParams,
    ToolParams,
)


def cell_params(
    cell: CellFile, profile: ProfileFile, tool: ToolFile, urdf: str, sensors: tuple[SensorParams, ...]
) -> Params:
    return Params(
        period_ns=cell.period_ms * 1_000_000,
        control=cell.control.level,
        silence_cycles=cell.control.silence_cycles,
        tracking_tolerance=math.radians(cell.control.tracking_tolerance_deg),
        robot=robot_params(profile, urdf),
        tool=tool_params(tool, profile.flange),
        safety=safety_params(cell.safety),
        human=_human(cell.human, sensors),
        task=TaskParams(cell.task.speed, math.radians(cell.task.goal_tolerance_deg), cell.task.slow_speed),
        monitor=MonitorParams(
            human_speed=cell.monitor.human_speed_m_s,
            intrusion_distance=cell.monitor.intrusion_m,
            robot_uncertainty=cell.monitor.robot_uncertainty_m,
            is_enforced=cell.monitor.enforce,
        ),
    )


def _human(human: Human, sensors: tuple[SensorParams, ...]) -> HumanParams:
    return HumanParams(
        slow_age_ns=_ns(human.slow_age_ms),
        age_limit_ns=_ns(human.age_limit_ms),
        future_limit_ns=_ns(human.future_limit_ms),
        clock_limit_ns=_ns(human.clock_limit_ms),
        slow_coverage=human.slow_coverage,
        least_coverage=human.least_coverage,
        sensors=sensors,
    )


def safety_params(safety: Safety) -> SafetyParams:
    return SafetyParams(
        d_min=safety.d_min_m,
        activation_distance=safety.activation_m,
        k=safety.k,
        eta=safety.eta,
        M_floor=safety.M_floor,
        human_acceleration=safety.human_acceleration_m_s2,
        rearm_distance=safety.rearm_distance_m,
        index=safety.index,
        brake=safety.brake_m_s2,
        v_max=safety.v_max_m_s,
    )


def robot_params(profile: ProfileFile, urdf: str) -> RobotParams:
    joints = profile.joints
    return RobotParams(
        name=profile.name,
        urdf=urdf,
        joints=tuple(joints.names),
        flange=profile.flange,
        q_min=radians([low for low, _ in joints.position_deg]),
        q_max=radians([high for _, high in joints.position_deg]),
        dq_max=radians(joints.velocity_deg_s),
        ddq_max=radians(joints.acceleration_deg_s2),
        dddq_max=radians(joints.jerk_deg_s3),
        effort=tuple(joints.effort_nm or ()),
        command_latency_ns=_ns(profile.command_latency_ms),
        capsules=tuple(_capsule(c.link, c) for c in profile.capsules),
    )


def tool_params(tool: ToolFile, flange: str) -> ToolParams:
    capsules = tuple(_capsule(flange, capsule) for capsule in tool.capsules)
    return ToolParams(tool.name, tool.mass_kg, tool.com, tool.inertia, capsules)


def _capsule(link: str, capsule: Capsule) -> CapsuleSpec:
    return CapsuleSpec(link, capsule.p0, capsule.p1, capsule.radius)


def radians(degrees: Sequence[float]) -> tuple[float, ...]:
    return tuple(math.radians(angle) for angle in degrees)


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e6)
