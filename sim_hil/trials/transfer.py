"""Does the index of one system hold on another?

The index is one number, k of phi*, made for panda+ee1. On another arm or tool it is covered where the survey that
certifies a k finds it so: states of that system, with its own masses, limits and capsules, are pulled onto phi = 0, and
at least REQUIRED of them must have a control within all limits that keeps the row. Where it is not, a cell with that
arm and tool is refused (`asc_rt.certified`); the trials run without asking, to see what the refusal was for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from asc_rt.synthesis.certify import certify, request_of
from asc_rt.synthesis.sampling import Ranges
from sim_hil.trials.systems import TrialSystem

REQUIRED = 0.999  # of the states on phi = 0, with all but a millionth of doubt; the default of `request_of`
SAMPLES = 50_000
V_MAX = 1.0  # m/s, the paper's


@dataclass(frozen=True, slots=True)
class Verdict:
    boundary_states: int  # on phi = 0
    feasible: int  # of them
    M_min: float  # m/s2, of all sampled states
    reasons: tuple[str, ...]  # why a cell is refused; (): the index is covered

    @property
    def is_covered(self) -> bool:
        return not self.reasons


@lru_cache(maxsize=64)
def verdict(system: TrialSystem, samples: int = SAMPLES) -> Verdict:
    """Of `system` at its own k, beside an obstacle that stands still."""
    params = system.params()
    ranges = Ranges(
        d_low=system.d_min,
        d_high=system.activation,
        v_max=V_MAX,
        speed_share=params.task.speed,
        human_speed=0.0,
        human_acceleration=0.0,
        joint_limits=True,
        links="tool",
    )
    found = certify(request_of(params, ranges, samples=samples, required=REQUIRED)).certificate
    return Verdict(found.boundary.states, found.boundary.feasible, found.sampled.M_min, found.reasons)
