"""The controller's alarms, as numbers and texts. Where no number is public, the number says what it is about."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Alarm:
    number: str
    text: str

    def about(self, detail: str) -> Alarm:
        return Alarm(self.number, f"{self.text} ({detail})")

    def __str__(self) -> str:
        return f"{self.number} {self.text}"


UNREACHABLE = Alarm("MOTN-018", "Position not reachable")
CONFIGURATION = Alarm("MOTN-156", "configuration change")
SEQUENCE = Alarm("MOTN-601", "ST: Sequence No. error")
DRY = Alarm("MOTN-603", "ST: Receiving interval over")
VERSION = Alarm("MOTN-607", "ST: Protocol version mismatch")
ABNORMAL = Alarm("MOTN-625", "ST: Position data is abnormal")
NOT_ASSIGNED = Alarm("PRIO-023", "I/O not assigned")
EMERGENCY_STOP = Alarm("SRVO-002", "Teach pendant E-stop")
EMERGENCY_COMPANION = Alarm("SRVO-289", "companion of SRVO-002 on a CRX (its text is not public)")
PENDANT = Alarm("TP-ENABLED", "teach pendant enabled (real alarm number unknown)")
OVERFLOW = Alarm("OVERFLOW", "more commands than the buffer holds (real alarm number unknown)")
UNKNOWN_PACKET = Alarm("HOST-380", "System error 0x19,0x0")
FOREIGN_START = Alarm("HOST-380", "System error 0x30,0x0")

# Velocity, acceleration, jerk: the number depends on the software generation.
LIMITS = {
    609: (
        Alarm("MOTN-609", "ST: joint velocity limit"),
        Alarm("MOTN-610", "ST: joint acceleration limit"),
        Alarm("MOTN-611", "ST: joint jerk limit"),
    ),
    720: (
        Alarm("MOTN-720", "ST: Exceeded Jnt Vel Limit"),
        Alarm("MOTN-721", "ST: Exceeded Jnt Acc/Dec Limit"),
        Alarm("MOTN-722", "ST: Exceeded Jnt Jerk Limit"),
    ),
}
