"""The baseline of the paper for a tool that is not known: one sphere that holds every tool that it could be."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from asc_rt.core.params import CapsuleSpec, ToolParams

NAME = "enclosing-sphere"
STEPS = 4000  # of the centre: within 1e-4 of the smallest radius; the sphere encloses them after any number
GRAIN = 1e-3  # m: the radius is rounded up to it, so that the data do not depend on how a machine rounds


def enclosing_sphere(tools: Sequence[ToolParams], flange: str) -> ToolParams:
    """The smallest sphere around all capsules of `tools` and the flange point, with the heaviest tool's mass at its
    centre. Centre by Badoiu and Clarkson (2003): steps of 1/i towards the farthest point.
    """
    ends = [(end, c.radius) for tool in tools for c in tool.capsules for end in (c.p0, c.p1)] + [((0.0, 0.0, 0.0), 0.0)]
    points, radii = np.array([end for end, _ in ends]), np.array([radius for _, radius in ends])
    centre = points.mean(axis=0)
    for i in range(1, STEPS + 1):
        reach = np.linalg.norm(points - centre, axis=1) + radii
        farthest = int(np.argmax(reach))
        towards = points[farthest] - centre
        length = float(np.linalg.norm(towards))
        if length == 0.0:
            break
        centre = centre + towards * (reach[farthest] / length) / (i + 1) * 0.5
    x, y, z = (float(round(value, 3)) for value in centre)
    middle = (x, y, z)
    reach = np.linalg.norm(points - np.array(middle), axis=1) + radii
    radius = math.ceil(float(reach.max()) / GRAIN - 1e-6) * GRAIN
    heaviest = max(tools, key=lambda tool: tool.mass)
    capsule = CapsuleSpec(flange, middle, middle, round(radius, 3))
    return ToolParams(NAME, heaviest.mass, heaviest.com, heaviest.inertia, (capsule,))
