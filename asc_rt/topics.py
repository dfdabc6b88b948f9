"""The table of bus keys: who says what to whom, how often, and how it is read."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import StrEnum


class Delivery(StrEnum):
    LATEST = "latest"  # a newer message replaces an older one
    QUEUE = "queue"  # every message counts, in order; ids increase
    ASKED = "asked"  # answered by the supervisor


@dataclass(frozen=True, slots=True)
class Topic:
    key: str
    payload: str  # protobuf message, or "json"
    rate_hz: float  # nominal; 0 = on events
    delivery: Delivery
    meaning: str


HUMAN = Topic("cell/human/*", "asc.v1.HumanState", 60, Delivery.LATEST, "people near the robot; each sensor: `human`")
OPERATOR = Topic(
    "cell/operator", "json", 0, Delivery.QUEUE, '{"id": int, "kind": "ARM" | "STOP" | "END" | "TOOL", "tool": int}'
)
GOAL = Topic("cell/goal", "json", 0, Delivery.LATEST, '{"id": int, "q": [rad, ...]}')
STATE = Topic("cell/state", "json", 10, Delivery.LATEST, "newest cycle, republished by the logger")
JOINTS = Topic(
    "cell/joints", "json", 50, Delivery.QUEUE, '{"t_ns": [int, ...], "q": [[rad, ...], ...]}: measured; from the logger'
)
CONTROL = Topic("cell/control", "json", 0, Delivery.QUEUE, "start, end and errors of the control process")
CLOCK = Topic("cell/clock", "json", 1, Delivery.ASKED, '{"id": str, "t_ns": int}: this machine\'s monotonic clock')
FAULT = Topic("sim/fault", "json", 0, Delivery.QUEUE, "a fault of the simulated robot, as in its script, now")
CAMERA_FAULT = Topic("sim/camera_fault", "json", 0, Delivery.QUEUE, "a fault of the simulated cameras, likewise")
CAMERA = Topic("cell/camera", "foxglove.CompressedImage", 15, Delivery.QUEUE, "what cameras see; frame_id: which")
CAMERA_CALIBRATION = Topic(
    "cell/camera_calibration", "foxglove.CameraCalibration", 1, Delivery.QUEUE, "their lenses; frame_id: which camera"
)
PERSON_TRUTH = Topic("sim/person", "asc.v1.HumanState", 125, Delivery.LATEST, "where the simulated person really is")
PLANT_TRUTH = Topic("sim/truth", "json", 125, Delivery.LATEST, "what the plant really did: q, dq, distance, contact")

SIM_DEVICES = ("fanuc", "can", "human", "camera")  # that a cell may have as [sim.*]; each says that it is `ready`
PERCEPTION = "perception"  # says so, too

TOPICS = (
    HUMAN, OPERATOR, GOAL, STATE, JOINTS, CONTROL, CLOCK, CAMERA, CAMERA_CALIBRATION, PERSON_TRUTH, PLANT_TRUTH, FAULT,
    CAMERA_FAULT,
)  # fmt: skip


def human(sensor: str) -> Topic:
    """Where the sensor of that name, one of the cell's human.sensors, says which people it sees."""
    return dataclasses.replace(HUMAN, key=f"cell/human/{sensor}")


def ready(device: str) -> Topic:
    """Said again and again by a simulated device, or by perception, from the moment it can be used."""
    return Topic(f"cell/ready/{device}", "json", 2, Delivery.LATEST, f"{device} can be used")


@dataclass(frozen=True, slots=True)
class Rights:
    """The keys that a peer on another machine may use; every other one is denied."""

    says: tuple[str, ...]
    hears: tuple[str, ...]
    asks: tuple[str, ...]


def rights(sensor: str) -> Rights:
    """Of a sensor of people: it says whom it sees and shows its images, and hears where the arm is, to tell it from
    them; it can neither arm nor set goals."""
    says = (human(sensor).key, CAMERA.key, CAMERA_CALIBRATION.key)
    return Rights(says=says, hears=(JOINTS.key,), asks=(CLOCK.key,))
