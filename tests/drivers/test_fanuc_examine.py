"""What `asc doctor` finds out about a robot, without a command to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fanuc_rig import A, B, Rig

from drivers.base import Finding

GOOD = {"robot", "robot limits", "robot override", "robot round trip", "robot cycle", "robot state", "robot pose"}


def examined(rig: Rig) -> dict[str, Finding]:
    findings = list(rig.driver.examine(rig.period_ns))
    assert all(found.ok or found.fix for found in findings)
    assert rig.commands() == [] and rig.offences == []
    np.testing.assert_array_equal(rig.plant.dq, 0)
    return {found.name: found for found in findings if found.name != "robot network"}


@pytest.mark.parametrize("wire", [A, B])
def test_a_good_robot(wire: str) -> None:
    rig = Rig(wire)
    found = examined(rig)
    assert set(found) >= GOOD and all(finding.ok for finding in found.values())
    assert found["robot cycle"].detail.startswith("8.00 ms")
    rig.begin()  # the link is free again
    rig.run(5)
    assert rig.offences == []


def repeat_most(rig: Rig) -> None:
    told: list[bytes] = []

    def thin(data: bytes) -> list[bytes]:
        told.append(data)
        return [data] if len(data) < 100 or len(told) % 10 else []

    rig.line.to_pc = thin


@pytest.mark.parametrize(
    ("wire", "prepare", "name", "says"),
    [
        (A, lambda rig: setattr(rig, "period_ns", 4_000_000), "robot cycle", "8.00 ms, the cell's period is 4 ms"),
        (A, repeat_most, "robot statuses", "lost"),
        (A, lambda rig: rig.robot.press_emergency_stop(), "robot state", "servo power is off"),
        (B, lambda rig: rig.robot.enable_pendant(), "robot pendant", "enabled"),
        (B, lambda rig: setattr(rig.rmi, "override", 30), "robot override", "30 %"),
        (B, lambda rig: setattr(rig.robot, "contact_stop", 2), "robot state", "contact stop"),
        (A, lambda rig: setattr(rig.line, "powered", False), "robot", "no answer"),
        (B, lambda rig: setattr(rig.line, "powered", False), "robot", "RMI does not answer"),
    ],
)
def test_what_is_wrong_is_named(wire: str, prepare: Callable[[Rig], Any], name: str, says: str) -> None:
    rig = Rig(wire)
    prepare(rig)
    found = examined(rig)
    assert not found[name].ok and says in found[name].detail


def test_a_version_that_the_robot_does_not_speak() -> None:
    found = examined(Rig(A, version=2))
    assert list(found) == ["robot handshake"] and "up to version 2" in found["robot handshake"].detail


def test_another_arm() -> None:
    found = examined(Rig(A, {"arm": "lrmate_200id_7l"}))
    assert not found["robot session"].ok and "driver.arm" in found["robot session"].fix
