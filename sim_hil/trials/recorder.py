"""A trial as a recording like any other: `asc view` shows it, `asc replay` runs its decisions again."""

from __future__ import annotations

import json
from pathlib import Path

from asc_rt.core.params import Params
from asc_rt.core.types import CoreState, CycleInputs, CycleOutputs
from asc_rt.fingerprint import fingerprint
from asc_rt.record import RecordLayout, Timings
from logs import schema
from logs.context import git_commit
from logs.display import Display
from logs.log_file import LogFile
from sim_hil.plant import MujocoPlant

CHANNELS = (schema.CYCLE, schema.TRUTH, schema.HELLO, *schema.DRAWN)


class Recorder:
    """One trial; the clock is the simulated one."""

    def __init__(self, path: Path, params: Params, about: dict[str, str]) -> None:
        """FileExistsError: recordings are never overwritten. OSError: the disk."""
        self._layout = RecordLayout(params.n)
        self._buffer = self._layout.buffer()
        self._display = Display(params, self._layout)
        attachments = {
            schema.PARAMS: params.canonical(),
            schema.FINGERPRINT: json.dumps(fingerprint(), indent=1).encode(),
            f"{params.robot.name}.urdf": params.robot.urdf.encode(),
        }
        session = {**about, "simulated": "true", "params_sha256": params.content_hash(), "git_commit": git_commit()}
        self._log = LogFile(path, attachments, session, CHANNELS)
        self._display.begin(self._log, 0)
        self.path = path

    def cycle(self, plant: MujocoPlant, before: CoreState, x: CycleInputs, out: CycleOutputs) -> None:
        self._layout.pack(self._buffer, before, x, out, None, Timings(*[x.t_ns] * 4))
        record = self._layout.sealed(self._buffer)
        self._log.message(schema.CYCLE, x.t_ns, record)
        self._display.cycle(self._log, x.t_ns, record)
        self._log.json(schema.TRUTH, x.t_ns, plant.truth(x.t_ns))

    def close(self, end: str) -> None:
        self._log.close({"reason": end})
