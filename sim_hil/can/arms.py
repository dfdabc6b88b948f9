"""The drives of the simulated arms. The figures repeat the driver's on purpose: the two must be able to disagree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sim_hil.can.cia402_drive import Cia402Drive, Data
from sim_hil.can.line import Drive
from sim_hil.can.mit_drive import MitDrive, Settings

# DATASHEET ranges; ASSUMED hold after silence, matched to what the joints carry.
_DM8009 = {"velocity": 45.0, "torque": 54.0, "hold_kp": 200.0, "hold_kd": 5.0}
_DM4340 = {"velocity": 10.0, "torque": 28.0, "hold_kp": 80.0, "hold_kd": 1.5}
_DM4310 = {"velocity": 30.0, "torque": 10.0, "hold_kp": 10.0, "hold_kd": 0.2}


@dataclass(frozen=True, slots=True)
class Arm:
    bitrate: float
    data_bitrate: float
    drives: Callable[[bool], Sequence[Drive]]  # argument: the nasty personality


def _mit(motors: Sequence[dict[str, float]]) -> Callable[[bool], Sequence[Drive]]:
    def make(nasty: bool) -> Sequence[Drive]:
        return [
            MitDrive(1 + i, 0x11 + i, Settings(**motor, serial=1000 + i, holds=not nasty))  # type: ignore[arg-type]
            for i, motor in enumerate(motors)
        ]

    return make


def _panda(nasty: bool) -> Sequence[Drive]:
    joints = [(87.0, 2000.0, 60.0)] * 2 + [(87.0, 1000.0, 15.0)] * 2 + [(12.0, 150.0, 1.5)] * 3
    limits = [(-166.003, 166.003), (-101.001, 101.001), (-166.003, 166.003), (-176.001, -3.999)]
    limits += [(-166.003, 166.003), (-1.003, 215.002), (-166.003, 166.003)]
    return [
        Cia402Drive(1 + i, Data(*joint, limits_deg=limits[i], serial=2000 + i, holds=not nasty))
        for i, joint in enumerate(joints)
    ]


ARMS = {
    "panda": Arm(1e6, 0.0, _panda),
    "openarm": Arm(1e6, 5e6, _mit([_DM8009] * 2 + [_DM4340] * 2 + [_DM4310] * 3)),
    "yam": Arm(1e6, 0.0, _mit([_DM4340] * 3 + [_DM4310] * 3)),
}
