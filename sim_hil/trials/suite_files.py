"""Suites as files: cells and the tools that come in them, a person, policies, and what the filter has to show."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from asc_rt.cell_files import Degree, Table, Text, integer, number
from asc_rt.config import ConfigError
from asc_rt.explain import explain

FOLDER = Path(__file__).parent / "suites.d"
SPHERE = "enclosing-sphere"
Policy = Literal["asc", "enclosing-sphere", "ssm-stop", "none"]


class SystemTable(Table):
    cell: Text  # a name, or a path as seen from where the command runs
    tools: Annotated[list[Text], Field(min_length=1)]  # mounted one after the other, within one trial
    goals_deg: list[list[Degree]] = []  # worked through in turn; []: the cell's own


class Seen(Table):
    """What the person is seen with."""

    rate_hz: Annotated[float, number(1, 1000)]
    latency_ms: tuple[Annotated[float, number(0, 1000)], Annotated[float, number(0, 1000)]]  # drawn per frame
    position_noise_m: Annotated[float, number(0, 1)]  # root mean square
    velocity_noise_m_s: Annotated[float, number(0, 5)]
    position_bound_m: Annotated[float, number(0, 1)]  # as stated in the message
    velocity_bound_m_s: Annotated[float, number(0, 5)]


class Rules(Table):
    """What is asked of `asc` beside this, always: no violation that the robot causes, no limit exceeded."""

    extra_share: Annotated[float, number(0, 10)] | None = None  # of the median distance that the sphere adds, at most
    more_goals: Annotated[bool, Field(strict=True)] = False  # than with the sphere, and each of them faster
    least_goals: Annotated[float, number(0, 1000)] = 0.0  # per trial, in the mean


class SuiteFile(Table):
    systems: Annotated[list[SystemTable], Field(min_length=1)]
    set: list[Text] = []  # over every cell file: "monitor.enforce=true", as `asc run --set` takes them
    person: Literal["stands", "visits", "roams", "live"]
    seed: Annotated[int, integer(0, 2**31 - 1)] = 0  # of every draw
    trials: Annotated[int, integer(1, 100000)]  # per system and policy
    seconds: Annotated[float, number(1, 3600)]  # of one trial
    clearance_m: Annotated[float, number(0, 5)] = 0.3  # of the arm at its start from a standing person
    free_m: Annotated[float, number(0, 5)] = (
        0.15  # from people: goals with the tools that come, and a tool when it is mounted
    )
    near_m: Annotated[float, number(0, 10)] = 10.0  # from a standing person, of the tool at one goal at least
    spread_deg: Annotated[float, number(0, 90)] = 0.0  # of each joint around each goal, drawn per trial
    patience_s: Annotated[float, number(0.1, 60)] = 1.5  # a goal that does not come nearer is left for the next
    policies: Annotated[list[Policy], Field(min_length=1)] = ["asc", "none"]
    seen: Seen
    verdict: Rules = Rules()


def load(path: Path) -> SuiteFile:
    """ConfigError: one line for each fault."""
    try:
        return SuiteFile.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise ConfigError([f"{path}: cannot be read: {error.strerror}"]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError([f"{path}: malformed TOML: {error}"]) from error
    except ValidationError as error:
        raise ConfigError([f"{path}: {line}" for line in explain(SuiteFile, error)]) from error
