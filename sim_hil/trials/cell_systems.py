"""The systems of a suite that is a file: the cell as `asc run` would run it, and the tools that come in a trial."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from asc_rt.certified import covered
from asc_rt.config import Cell, ConfigError, load_cell
from asc_rt.core.params import STAND_IN, Params, ToolParams
from asc_rt.synthesis.certificate import refusals
from sim_hil.person import Array

NOBODY_KNOWS = 2**30  # number of a tool that no cell has


@dataclass(frozen=True, slots=True)
class CellSystem:
    """`tools` in the order in which they are mounted; more than one needs a changer that tells which it holds."""

    cell: str  # name or file
    tools: tuple[str, ...]
    goals_deg: tuple[tuple[float, ...], ...] = ()  # (): the cell's
    overrides: tuple[str, ...] = ()  # of the cell file, as `asc run --set` takes them

    @property
    def loaded(self) -> Cell:
        """ConfigError."""
        return _cell(self.cell, self.tools[0], self.overrides)

    @property
    def name(self) -> str:
        return "+".join((self.loaded.name, *self.tools))

    @property
    def control(self) -> str:
        return self.loaded.params.control

    @property
    def d_min(self) -> float:
        return self.loaded.params.safety.d_min

    @property
    def k(self) -> float | None:
        """Of phi*; None: the cell has another index."""
        safety = self.loaded.params.safety
        return safety.k if safety.index == "phi-star" else None

    @property
    def goals(self) -> Array:
        """(g, n) rad"""
        return np.radians(self.goals_deg) if self.goals_deg else np.array(self.loaded.goals)

    def params(self) -> Params:
        """Of the cell, its tools marked whose certificate covers them, as before a run."""
        cell = self.loaded
        return covered(cell, cell.params)[0]

    def mounts(self) -> list[tuple[int, ToolParams]]:
        """Number, as the changer tells it, and tool, in the order in which they are mounted."""
        params = self.loaded.params
        if not params.changer.mounts:
            return [(0, params.tool)]
        by_name = {mount.tool.name: (mount.number, mount.tool) for mount in params.changer.mounts}
        return [by_name[name] for name in self.tools]

    def sphere(self) -> ToolParams | None:
        """What the cell takes an unknown tool for."""
        mounts = self.loaded.params.changer.mounts
        return next((mount.tool for mount in mounts if mount.number == STAND_IN), None)

    def faults(self, needs_sphere: bool) -> list[str]:
        """Why no trial can be run; one line each."""
        try:
            cell = self.loaded
        except ConfigError as error:
            return list(error.lines)
        known = [mount.tool.name for mount in cell.params.changer.mounts if mount.number != STAND_IN]
        lines = [
            f"tools: {tool!r} is not mounted in cell {cell.name}; one of {', '.join(known)}"
            for tool in self.tools
            if known and tool not in known
        ]
        if len(self.tools) > 1 and not cell.params.changer.told_by_robot:
            lines.append(
                f"tools: nobody tells a swap in cell {cell.name}; one tool, or a cell with tools.told_by = robot"
            )
        if needs_sphere and self.sphere() is None:
            lines.append(f"policies: cell {cell.name} has no enclosing sphere; set its tools.unknown, or leave it out")
        if not cell.uncertified and not known:
            lines += [f"cell {cell.name}: {reason}" for reason in refusals(cell.params, cell.certificates)]
        names = [*self.tools, *([self.sphere().name] if needs_sphere and self.sphere() else [])]  # type: ignore[union-attr]
        for mount in self.params().changer.mounts:
            if mount.tool.name in names and not mount.covered:
                lines.append(f"tools: {mount.tool.name} on {cell.params.robot.name} has no certificate that covers it")
        wide = [len(goal) for goal in self.goals_deg if len(goal) != cell.params.n]
        if wide:
            lines.append(f"goals_deg: {wide[0]} angles; {cell.params.robot.name} has {cell.params.n} joints")
        return lines


@lru_cache(maxsize=32)
def _cell(name: str, tool: str, overrides: tuple[str, ...]) -> Cell:
    """A cell without a changer is taken with the tool of the suite."""
    cell = load_cell(name, overrides)
    return cell if cell.params.changer.mounts else load_cell(name, [*overrides, f"tool={tool}"])
