"""Has the camera moved since it was calibrated? The robot is the target that always stands in its view.

The arm's capsules, placed by the joints at the moment of capture, are drawn into the depth picture. Where the camera
measures the robot, the points should lie on the capsules: a displacement xi (6, parent's axes, see
calibration.geometry.perturb) of the camera is fitted to their signed distances s(p), d s / d xi = n^T [I, -[p - c]x]
with n the outward normal and c the camera (iterated, Huber's weights). Refused beyond half the self-filter's margin:
what the fit moves the robot's points by, what sticks out of the capsules, and a robot that is not where it should be.
The capsules must describe the surface well; a mark of their slack is the shift found on the day of calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asc_rt.core import kinematics
from asc_rt.core.robot_model import RobotModel
from calibration import vision
from calibration.geometry import difference, perturb
from calibration.result import CalibrationError

MARGIN = 0.04  # m, of the self-filter: MEASURED as what 20 ms and 10 mm of error need (perception's facts)
STRIDE = 4  # px between the rays that are looked at
LEAST_POINTS = 300
HUBER = 0.005  # m
MOST_ABSENT = 0.2  # share of the robot's pixels that measure something behind it
GRAZING = 0.3  # cosine of the angle of incidence; flatter surfaces are not believed


@dataclass(frozen=True, slots=True)
class Frame:
    depth: np.ndarray  # (h, w) m along the optical axis; 0: no measurement
    q: np.ndarray  # (dof,) rad at the moment of capture


@dataclass(frozen=True, slots=True)
class Drift:
    xi: np.ndarray  # (6,) m, rad: how the camera has moved, parent's axes
    sigma: np.ndarray  # (6,)
    shift: float  # m, largest displacement of a point of the robot
    outside: float  # m by which 1 % of the robot's points stick out of the capsules
    absent: float  # share of the robot's pixels that measure something behind it
    points: int
    reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Scene:
    """Capsules in the base frame."""

    p0: np.ndarray  # (m, 3) m
    p1: np.ndarray
    radius: np.ndarray  # (m,)

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) m signed distance to the nearest surface, (n, 3) its outward normal."""
        axis = self.p1 - self.p0
        along = np.einsum("nmk,mk->nm", points[:, None] - self.p0, axis) / np.maximum(np.sum(axis**2, 1), 1e-12)
        nearest = self.p0 + np.clip(along, 0, 1)[..., None] * axis
        gap = points[:, None] - nearest
        length = np.linalg.norm(gap, axis=2)
        best = np.argmin(length - self.radius, axis=1)
        rows = np.arange(len(points))
        far = np.maximum(length[rows, best], 1e-9)
        return length[rows, best] - self.radius[best], gap[rows, best] / far[:, None]


def place(model: RobotModel, q: np.ndarray) -> Scene:
    """The arm's capsules at `q`, without those of the base that never move: a table hides them."""
    motion = kinematics.forward(model.chain, q, np.zeros_like(q))
    moving = model.capsules.joint >= 0
    joint = model.capsules.joint[moving]
    p0, p1 = (
        np.einsum("mij,mj->mi", motion.rotation[joint], p[moving]) + motion.origin[joint]
        for p in (model.capsules.p0, model.capsules.p1)
    )
    return Scene(p0, p1, model.capsules.radius[moving])


def expected(scene: Scene, T_base_cam: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) m along each ray of unit length to the robot, inf: past it; (n,) cosine of the incidence. Sphere tracing."""
    directions = rays @ T_base_cam[:3, :3].T
    reached, open_ = np.zeros(len(rays)), np.ones(len(rays), bool)
    for _ in range(60):
        points = T_base_cam[:3, 3] + reached[open_, None] * directions[open_]
        gap = scene.distance(points)[0]
        reached[open_] += gap
        going = np.flatnonzero(open_)
        open_[going[(gap < 1e-4) | (reached[going] > 6)]] = False
    reached[(reached > 6) | open_] = np.inf
    hit = np.isfinite(reached)
    cosine = np.zeros(len(rays))
    normal = scene.distance(T_base_cam[:3, 3] + reached[hit, None] * directions[hit])[1]
    cosine[hit] = -np.sum(normal * directions[hit], axis=1)
    return reached, cosine


def check(
    model: RobotModel, frames: list[Frame], K: np.ndarray, distortion: np.ndarray, T_base_cam: np.ndarray,
    margin: float = MARGIN,
) -> Drift:  # fmt: skip
    """Against all `frames` together. CalibrationError: the robot is hardly in view."""
    T, scenes, clouds, absent, robot = T_base_cam, [], [], 0, 0
    v, u, flat = grid(frames[0].depth.shape, K, distortion)
    scale = np.linalg.norm(flat, axis=1)
    for frame in frames:
        scene, z = place(model, frame.q), frame.depth[v, u]
        reached, cosine = expected(scene, T, flat / scale[:, None])
        solid = (cosine > GRAZING) & (z > 0)
        behind = z * scale - reached > 2 * margin
        absent, robot = absent + int(np.sum(solid & behind)), robot + int(np.sum(solid))
        cloud = (flat * z[:, None])[z > 0]
        scenes.append(scene)
        clouds.append(cloud[scene.distance(cloud @ T[:3, :3].T + T[:3, 3])[0] < 2 * margin])
    count = sum(len(cloud) for cloud in clouds)
    if robot < LEAST_POINTS:
        few = f"{robot * STRIDE**2} pixels of the robot are in view; at least {LEAST_POINTS * STRIDE**2}"
        raise CalibrationError([f"{few}: move it before the camera"])
    if absent > MOST_ABSENT * robot or count < LEAST_POINTS:
        share = f"{absent / robot:.0%} of its pixels measure something behind it"
        gone = f"the robot is not where it is drawn: {share}; calibrate again"
        return Drift(np.zeros(6), np.full(6, np.inf), np.inf, np.inf, absent / robot, count, (gone,))
    xi, sigma, moved, outside = _fit(scenes, clouds, T, 2 * margin)
    reasons = []
    for name, value in (("shift", moved), ("outside", outside)):
        if not value <= margin / 2:
            limit = f"{1e3 * value:.1f} mm; at most {1e3 * margin / 2:g}, half the self-filter's margin"
            reasons.append(f"{name} {limit}: the camera or the robot's base has moved; calibrate again")
    return Drift(xi, sigma, moved, outside, absent / robot, count, tuple(reasons))


def grid(shape: tuple[int, ...], K: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) rows and (n,) columns of the pixels that are looked at, and (n, 3) their rays with z = 1."""
    v, u = np.mgrid[STRIDE // 2 : shape[0] : STRIDE, STRIDE // 2 : shape[1] : STRIDE].reshape(2, -1)
    rays = vision.rays(np.column_stack([u, v]).astype(float), K, distortion)
    return v, u, rays / rays[:, 2:]


def _fit(
    scenes: list[Scene], clouds: list[np.ndarray], T: np.ndarray, limit: float
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """xi, its sigma, the largest shift of a point, and what sticks out before the fit (m)."""
    moved, outside = T, 0.0
    for turn in range(15):
        J, r, points = [], [], []
        for scene, cloud in zip(scenes, clouds, strict=True):
            p = cloud @ moved[:3, :3].T + moved[:3, 3]
            s, n = scene.distance(p)
            J.append(np.hstack([n, np.cross(p - moved[:3, 3], n)]))
            r.append(s)
            points.append(p)
        A, b, cloud_now = np.concatenate(J), np.concatenate(r), np.concatenate(points)
        if turn == 0:
            outside, first = float(np.quantile(b, 0.99)), cloud_now
        weight = np.where(np.abs(b) < limit, np.minimum(1, HUBER / np.maximum(np.abs(b), 1e-12)), 0.0)
        H = (A * weight[:, None]).T @ A
        step = -np.linalg.lstsq(H, A.T @ (weight * b), rcond=1e-9)[0]
        moved = perturb(moved, step)
        if np.abs(step).max() < 1e-7:
            break
    now = np.concatenate([c @ moved[:3, :3].T + moved[:3, 3] for c in clouds])
    variance = float(np.sum(weight * b**2) / max(np.sum(weight > 0) - 6, 1))
    sigma = np.sqrt(variance * np.diag(np.linalg.pinv(H)))
    return difference(moved, T), sigma, float(np.linalg.norm(now - first, axis=1).max()), outside
