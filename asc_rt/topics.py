"""The table of bus keys: who says what to whom, how often, and how it is read."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Delivery(StrEnum):
    LATEST = "latest"  # a newer message replaces an older one
    QUEUE = "queue"  # every message counts, in order; ids increase


@dataclass(frozen=True, slots=True)
class Topic:
    key: str
    payload: str  # protobuf message, or "json"
    rate_hz: float  # nominal; 0 = on events
    delivery: Delivery
    meaning: str


HUMAN = Topic("cell/human", "asc.v1.HumanState", 60, Delivery.LATEST, "people near the robot, with bounds")
OPERATOR = Topic("cell/operator", "json", 0, Delivery.QUEUE, '{"id": int, "kind": "ARM" | "STOP" | "END"}')
GOAL = Topic("cell/goal", "json", 0, Delivery.LATEST, '{"id": int, "q": [rad, ...]}')
STATE = Topic("cell/state", "json", 10, Delivery.LATEST, "newest cycle, republished by the logger")
CONTROL = Topic("cell/control", "json", 0, Delivery.QUEUE, "start, end and errors of the control process")
CAMERA = Topic("cell/camera", "foxglove.CompressedImage", 15, Delivery.QUEUE, "what cameras see; frame_id: which")
PERSON_TRUTH = Topic("sim/person", "asc.v1.HumanState", 125, Delivery.LATEST, "where the simulated person really is")
PLANT_TRUTH = Topic("sim/truth", "json", 125, Delivery.LATEST, "what the plant really did: q, dq, distance, contact")

# The simulated devices that a cell may have as [sim.*], and by what one can hear that they run.
SIM_DEVICES = {"fanuc": PLANT_TRUTH, "human": PERSON_TRUTH}

TOPICS = (HUMAN, OPERATOR, GOAL, STATE, CONTROL, CAMERA, PERSON_TRUTH, PLANT_TRUTH)


def ready(device: str) -> Topic:
    """Said again and again by a simulated device from the moment it can be used."""
    return Topic(f"sim/ready/{device}", "json", 2, Delivery.LATEST, f"simulated {device} can be used")
