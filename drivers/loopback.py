"""A robot that is where it was last told to be. For tests and for the host-paced loop; fails on demand."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from asc_rt.core.types import CommandKind, JointCommand, JointState, RobotFlag, StopRequest, Vector, vector
from drivers.base import DriverCaps, HandshakeError, LinkError, Pacing, RobotFaulted, WireTap, WriteReceipt

FAULTS = ("none", "silence", "raise", "nan")


class Loopback:
    """Options: `q` start pose [rad] (6 zeros), `period_ms` (8), `fault` (of FAULTS) after `fault_after` reads (0)."""

    def __init__(self, options: dict[str, Any], tap: WireTap | None = None) -> None:
        unknown = sorted(set(options) - {"q", "period_ms", "fault", "fault_after"})
        if unknown:
            raise ValueError(f"loopback: unknown option {', '.join(unknown)}; known: q, period_ms, fault, fault_after")
        self._start = _pose(options.get("q", [0.0] * 6))
        self._period_ns = round(_positive(options.get("period_ms", 8.0)) * 1e6)
        self._fault = options.get("fault", "none")
        if self._fault not in FAULTS:
            raise ValueError(f"loopback: fault must be one of {', '.join(FAULTS)}, not {self._fault!r}")
        self._fault_after = options.get("fault_after", 0)
        if not isinstance(self._fault_after, int) or self._fault_after < 0:
            raise ValueError(f"loopback: fault_after must be a count of reads, not {self._fault_after!r}")
        self._tap = tap
        self.fault: RobotFaulted | None = None
        self._active = False
        self._reset()

    def _reset(self) -> None:
        self._q = self._start
        self._dq = vector(np.zeros_like(self._start))
        self._seq = 0
        self._sent = 0

    def configure(self) -> DriverCaps:
        return DriverCaps(
            dof=len(self._start),
            pacing=Pacing.HOST,
            kinds=frozenset({CommandKind.POSITION}),
            period_ns=self._period_ns,
            identity="loopback",
        )

    def activate(self, period_ns: int) -> JointState:
        if period_ns != self._period_ns:
            raise HandshakeError(
                f"the loopback's period is {self._period_ns} ns, the cell's {period_ns} ns",
                hint="make the cell's period and the driver's period_ms equal",
            )
        self._reset()
        self._active = True
        return self._sample(self._q)

    def read(self, deadline_ns: int) -> JointState | None:
        if not self._active:
            raise LinkError("the loopback is not active", hint="activate() comes before read()")
        self._seq += 1
        if self._fault == "none" or self._seq <= self._fault_after:
            return self._sample(self._q)
        if self._fault == "silence":
            return None
        if self._fault == "raise":
            raise LinkError("the loopback failed as configured", hint="take the option `fault` away")
        return self._sample(vector(np.full_like(self._q, np.nan)))

    def write(self, command: JointCommand) -> WriteReceipt:
        q = vector(command.q)
        if command.kind is not CommandKind.POSITION or q.shape != self._q.shape or not np.isfinite(q).all():
            raise ValueError("the loopback takes finite joint positions only, one for each joint")
        if not self._active:
            raise LinkError("the loopback is not active", hint="activate() comes before write()")
        t_ns = time.monotonic_ns()
        if self._tap is not None:
            self._tap("tx", t_ns, q.tobytes())
        self._dq = vector((q - self._q) / (self._period_ns * 1e-9))
        self._q = q
        self._sent += 1
        return WriteReceipt(t_ns, self._sent, q, ok=True)

    def stop(self, request: StopRequest | None = None) -> None:
        self._active = False

    def close(self) -> None:
        self._active = False

    def _sample(self, q: Vector) -> JointState:
        t_ns = time.monotonic_ns()
        if self._tap is not None:
            self._tap("rx", t_ns, q.tobytes())
        return JointState(
            t_rx_ns=t_ns,
            t_device_ns=t_ns,
            seq=self._seq,
            q=q,
            dq=self._dq,
            current=vector(np.zeros_like(q)),
            flags=RobotFlag.READY | RobotFlag.SERVO_ON,
            tool_id=0,
            dq_is_estimated=True,
        )


def _pose(value: object) -> Vector:
    try:
        q = vector(value)
    except (TypeError, ValueError):
        q = vector([])
    if q.ndim != 1 or not q.size or not np.isfinite(q).all():
        raise ValueError(f"loopback: q must be a list of joint angles [rad], not {value!r}")
    return q


def _positive(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value <= 0:
        raise ValueError(f"loopback: period_ms must be a positive number, not {value!r}")
    return float(value)
