"""The arms that this driver knows: data of their drives. Every figure with its provenance; limits live in the cell."""

from __future__ import annotations

import math
from fractions import Fraction

from drivers.can.arm import ArmCodec, Joint
from drivers.can.cia402 import Scale
from drivers.can.cia402_arm import Cia402Arm
from drivers.can.mit_arm import MitArm, MitAxis

# Nms/rad. A step of the speed's code is then 1 / 24 to 1 / 140 of one of the torque's, and half of that one is a speed
# of at most 0.5 rad/s.
_FINE_KD = {"DM8009": 40 * 5.0 / 4095, "DM4340": 20 * 5.0 / 4095, "DM4310": 4 * 5.0 / 4095}

# DATASHEET position limits and velocities. ASSUMED: the deceleration of the coordinated stop, a share of what the
# torque allows; that the drives hold on silence has to be MEASURED on each arm before people come near it.


def _joint(low_deg: float, high_deg: float, dq_max: float, brake: bool = False, stop_ddq: float = 8.0) -> Joint:
    return Joint(math.radians(low_deg), math.radians(high_deg), dq_max, stop_ddq, brake, holds_on_silence=True)


def _openarm() -> MitArm:
    """OpenArm v1: two DM8009, two DM4340, three DM4310 on CAN FD 1/5 Mbit/s; no brakes. DATASHEET identifiers."""
    # ASSUMED gains: as stiff as the damping of at most 5 Nms/rad allows on the inertia that each joint carries.
    motors = [("DM8009", 150.0, 5.0)] * 2 + [("DM4340", 80.0, 1.5)] * 2 + [("DM4310", 15.0, 0.2)] * 3
    limits = [(-80, 200, 16.8), (-100, 100, 16.8), (-90, 90, 5.4), (0, 140, 5.4)]
    limits += [(-90, 90, 20.9), (-45, 45, 20.9), (-90, 90, 20.9)]
    axes = (MitAxis(m, 1 + i, 0x11 + i, kp, kd, _FINE_KD[m], firmware=(5013,)) for i, (m, kp, kd) in enumerate(motors))
    return MitArm(tuple(_joint(*limit) for limit in limits), tuple(axes), 1e6, 5e6)


def _yam() -> MitArm:
    """YAM: three DM4340, three DM4310 on classic CAN at 1 Mbit/s; no brakes. DATASHEET gains 80 and 10."""
    motors = [("DM4340", 80.0, 5.0)] * 3 + [("DM4310", 10.0, 1.5)] * 3
    axes = (MitAxis(m, 1 + i, 0x11 + i, kp, kd, _FINE_KD[m]) for i, (m, kp, kd) in enumerate(motors))
    limits = [(-180.0, 180.0, 8.0)] * 6  # ASSUMED: the published model has placeholders
    return MitArm(tuple(_joint(*limit) for limit in limits), tuple(axes), 1e6, 0.0)


def _panda() -> Cia402Arm:
    """A Panda's joints on CiA 402 drives with brakes, classic CAN at 1 Mbit/s.

    ASSUMED all: such an arm is not sold; the torques are the arm's efforts."""
    limits = [(-166.003, 166.003, 2.17), (-101.001, 101.001, 2.17), (-166.003, 166.003, 2.17), (-176.001, -3.999, 2.17)]
    limits += [(-166.003, 166.003, 2.61), (-1.003, 215.002, 2.61), (-166.003, 166.003, 2.61)]
    scales = (Scale(1 << 17, Fraction(100), torque) for torque in [87.0] * 4 + [12.0] * 3)
    joints = (_joint(*limit, brake=True, stop_ddq=5.0) for limit in limits)
    return Cia402Arm(tuple(joints), tuple(range(1, 8)), tuple(scales), revisions=(0x0002_0001,))


ARMS: dict[str, ArmCodec] = {"openarm": _openarm(), "yam": _yam(), "panda": _panda()}
