"""Where is the camera that watches the robot? T_base_cam and T_flange_board from views of a board on the flange.

Model: pixels of view i are those of T_cam_board,i = inv(T_base_cam) T_base_flange,i E_i T_flange_board, where E_i is
the error of the robot's pose (repeatability, kinematics), the same for all corners of a view. Leaving E_i out makes the
covariance 4 to 6 times too small, so each E_i is an unknown with a prior, and the cost is the negative log posterior.
Since E_i enters through the board's pose only, a view's corners are first condensed to that pose and its information
matrix (Gauss-Newton at the optimum of the reprojection error); E_i is then marginalised in closed form:
residual r_i (6) with covariance  C_pixel,i + J_i C_robot J_i^T. The rest is least squares in 12 unknowns, and in the
errors of the intrinsics, whose prior is their own covariance: a focal length wrong by a pixel moves every board alike.

Closed-form start: robot-world / hand-eye A_i X = Z B_i by Kronecker product and SVD (Shah 2013).
Eye-in-hand is the same equation with the robot's poses inverted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.special import chdtri

from calibration.geometry import difference, inverse, log, perturb, pose, skew
from calibration.result import CalibrationError, Result, pose_value, rows
from calibration.touch import Touch

LEAST_POSES = 8
HOLD_OUT = 4  # the last views; they take no part in the fit
LEAST_ROTATION_DEG = 30.0  # spread about the second-best axis; below it the translation is ill-determined
GROSS = 10.0  # chi2 per degree of freedom beyond which no more need be asked
SQUARE_SIGMA = 5e-4  # of the square's side, ASSUMED: 0.1 mm on a board 250 mm wide, read off a steel rule
WIDE = 0.1  # prior of a board of unknown size
MOST_SQUARE = 4.0  # sigma
CHI2_TAIL = 1e-3  # share of good calibrations that the test refuses


@dataclass(frozen=True, slots=True)
class RobotNoise:
    """Standard deviation of one flange pose: repeatability and kinematic error together."""

    translation: float = 0.5e-3  # m, ASSUMED for a small industrial arm; its data sheet tells repeatability only
    rotation: float = 5.2e-4  # rad, ASSUMED (0.03 deg)

    @property
    def covariance(self) -> np.ndarray:
        return np.diag([self.translation**2] * 3 + [self.rotation**2] * 3)


@dataclass(frozen=True, slots=True)
class Views:
    """n views: the robot's pose and the board's pose in the camera with what the pixels say of its error."""

    flange: np.ndarray  # (n, 4, 4) T_base_flange
    board: np.ndarray  # (n, 4, 4) T_cam_board
    covariance: np.ndarray  # (n, 6, 6) of `board`, parent's axes (see calibration.geometry.perturb)
    lens: (
        np.ndarray
    )  # (n, 6, k) how `board` moves with the k errors that all views share (intrinsics, square), of unit variance

    def subset(self, keep: np.ndarray) -> Views:
        return Views(self.flange[keep], self.board[keep], self.covariance[keep], self.lens[keep])

    def __len__(self) -> int:
        return len(self.flange)


@dataclass(frozen=True, slots=True)
class Solution:
    T_base_cam: np.ndarray  # (4, 4)
    T_flange_board: np.ndarray  # (4, 4)
    covariance: np.ndarray  # (12, 12): base_cam, flange_board
    chi2: float
    dof: int
    shared: np.ndarray  # (k,) the errors that all views share, in their prior sigmas
    shared_sigma: np.ndarray  # (k,) what is left of them

    @property
    def chi2_dof(self) -> float:
        return self.chi2 / self.dof


def start(views: Views) -> tuple[np.ndarray, np.ndarray]:
    """T_base_cam, T_flange_board by A X = Z B with A = T_base_flange, X = T_flange_board, Z = T_base_cam."""
    A, B = views.flange, views.board
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    K = sum(np.kron(a, b) for a, b in zip(RA, RB, strict=True))  # row-major vec: vec(RA^T RZ RB) = (RA x RB)^T vec RZ
    U, _, Vt = np.linalg.svd(K)
    RZ, RX = _rotation(U[:, 0].reshape(3, 3)), _rotation(Vt[0].reshape(3, 3))
    n = len(views)
    H = np.hstack([RA.reshape(-1, 3), -np.tile(np.eye(3), (n, 1))])
    h = ((RZ @ B[:, :3, 3:])[..., 0] - A[:, :3, 3]).ravel()
    x = np.linalg.lstsq(H, h, rcond=None)[0]
    return pose(RZ, x[3:]), pose(RX, x[:3])


def _rotation(M: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(M * np.sign(np.linalg.det(M)))
    return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt


def solve(views: Views, noise: RobotNoise) -> Solution:
    """Maximum likelihood, the robot's pose errors marginalised. Covariance: the inverse information there."""
    Z0, X0 = start(views)

    def placed(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return perturb(Z0, x[:6]), perturb(X0, x[6:12])

    def whitened(x: np.ndarray) -> np.ndarray:
        Z, X = placed(x)
        predicted = inverse(Z) @ views.flange @ X
        r = difference(views.board, predicted) - views.lens @ x[12:]
        return np.concatenate([np.linalg.solve(roots, r[..., None])[..., 0].ravel(), x[12:]])

    roots = np.linalg.cholesky(_residual_covariance(views, Z0, X0, noise))
    at = np.zeros(12 + views.lens.shape[2])
    for _ in range(3):  # the weights depend on the optimum, weakly
        found = least_squares(whitened, at, method="lm", x_scale="jac", max_nfev=10 * (len(at) + 1))
        Z0, X0 = placed(found.x)
        at = np.concatenate([np.zeros(12), found.x[12:]])
        roots = np.linalg.cholesky(_residual_covariance(views, Z0, X0, noise))
        if 2 * found.cost > GROSS * 6 * len(views):  # no calibration: it will be refused
            break
    J = _jacobian(whitened, at)
    C = np.linalg.inv(J.T @ J)
    left = np.sqrt(np.diag(C)[12:])
    return Solution(Z0, X0, C[:12, :12], float(2 * found.cost), 6 * len(views) - 12, at[12:], left)


def _jacobian(f: object, x: np.ndarray, h: float = 1e-6) -> np.ndarray:
    return np.stack([(f(x + d) - f(x - d)) / (2 * h) for d in h * np.eye(len(x))], 1)  # type: ignore[operator]


def _residual_covariance(views: Views, Z: np.ndarray, X: np.ndarray, noise: RobotNoise) -> np.ndarray:
    """(n, 6, 6): the pixels' share and the robot's, whose error is in the flange's axes at the flange's origin."""
    R = inverse(Z)[:3, :3] @ views.flange[:, :3, :3]
    J = np.zeros((len(views), 6, 6))
    J[:, :3, :3], J[:, 3:, 3:] = R, R
    J[:, :3, 3:] = -R @ skew(X[:3, 3])
    return views.covariance + J @ noise.covariance @ np.swapaxes(J, -1, -2)


# --- is it fit to be used? -------------------------------------------------------------------------------------------


def calibrate(
    views: Views, noise: RobotNoise | None = None, hold_out: int = HOLD_OUT, touch: Touch | None = None
) -> tuple[Result, Solution]:
    """The result for a camera beside the robot, accepted or with every reason against it.

    The last `hold_out` views take no part in the fit; they are compared with it. Units: m, rad.
    """
    noise = noise or RobotNoise()
    if len(views) < LEAST_POSES + hold_out:
        raise CalibrationError(
            [f"views: {len(views)} are too few; at least {LEAST_POSES + hold_out}, {hold_out} held out"]
        )
    fit, held = (
        views.subset(np.arange(len(views) - hold_out)),
        views.subset(np.arange(len(views) - hold_out, len(views))),
    )
    solution = solve(fit, noise)
    quality: dict[str, object] = {
        "poses": len(fit),
        "rotation_deg": rotation_spread(fit.flange[:, :3, :3]),
        "chi2_dof": solution.chi2_dof,
        "rms": _rms(solution, fit),
        "holdout": _rms(solution, held),
        "holdout_chi2_dof": _chi2(solution, held, noise) / (6 * hold_out),
        "jack_knife_mm": jack_knife(fit, noise, solution) if solution.chi2_dof < GROSS else None,
    }
    reasons = _reasons(fit, noise, solution, quality, hold_out)
    if touch is not None:
        quality["touch_mm"], against = touch.compare(solution.T_base_cam, solution.covariance[:6, :6])
        reasons += against
    result = Result(
        "hand-eye", "T_base_cam", pose_value(solution.T_base_cam), rows(solution.covariance[:6, :6]),
        "maximum likelihood, robot pose error marginalised; start by Kronecker product",
        quality=quality, reasons=tuple(reasons),
    )  # fmt: skip
    return result, solution


def rotation_spread(R: np.ndarray) -> float:
    """deg: the spread of orientations (n, 3, 3) about the second-best axis, from the rotations between all pairs."""
    i, j = np.triu_indices(len(R), 1)
    w = log(R[i] @ np.swapaxes(R[j], -1, -2))
    middle = np.linalg.eigvalsh(w.T @ w / len(w))[1]
    return float(np.degrees(np.sqrt(middle) * 2))


def _rms(solution: Solution, views: Views) -> float:
    """m: how far the board is from where the calibration expects it."""
    predicted = inverse(solution.T_base_cam) @ views.flange @ solution.T_flange_board
    return float(np.sqrt(np.mean(np.sum((predicted[:, :3, 3] - views.board[:, :3, 3]) ** 2, axis=1))))


def whitened_residuals(solution: Solution, views: Views, noise: RobotNoise) -> np.ndarray:
    """(n, 6) in sigma: of unit variance if everything was said honestly."""
    Z, X = solution.T_base_cam, solution.T_flange_board
    r = difference(views.board, inverse(Z) @ views.flange @ X) - views.lens @ solution.shared
    roots = np.linalg.cholesky(_residual_covariance(views, Z, X, noise))
    return np.asarray(np.linalg.solve(roots, r[..., None])[..., 0])


def _chi2(solution: Solution, views: Views, noise: RobotNoise) -> float:
    return float(np.sum(whitened_residuals(solution, views, noise) ** 2))


def jack_knife(views: Views, noise: RobotNoise, whole: Solution, groups: int = 5) -> float:
    """mm: sigma of the camera's position from leaving out one group of views after the other."""
    n, moved = len(views), []
    for g in range(groups):
        part = solve(views.subset(np.arange(n) % groups != g), noise)
        moved.append(part.T_base_cam[:3, 3] - whole.T_base_cam[:3, 3])
    return float(1e3 * np.sqrt((groups - 1) / groups * np.sum(np.square(moved))))


def _reasons(
    views: Views, noise: RobotNoise, solution: Solution, quality: dict[str, object], hold_out: int
) -> list[str]:
    reasons = []
    spread = rotation_spread(views.flange[:, :3, :3])
    if spread < LEAST_ROTATION_DEG:
        reasons.append(
            f"rotation {spread:.0f} deg about a second axis; turn the flange by {LEAST_ROTATION_DEG:.0f} or more"
        )
    against: list[str] = []
    for name, value, dof in (
        ("chi2_dof", solution.chi2_dof, solution.dof),
        ("holdout_chi2_dof", float(quality["holdout_chi2_dof"]), 6 * hold_out),  # type: ignore[arg-type]
    ):
        most = chdtri(dof, CHI2_TAIL) / dof
        if name != "chi2_dof":
            most *= 1.5  # the fit's own error comes on top of the held-out view's
        if not value <= most:
            against.append(f"{name} {value:.3g} is above {most:.3g}: the poses and the pixels contradict each other")
    reasons += [*against, *(explain(views, noise) if against else square_size(views, noise))]
    stated = 1e3 * float(np.sqrt(np.trace(solution.covariance[:3, :3])))
    if float(quality["jack_knife_mm"] or 0.0) > 4 * stated:  # type: ignore[arg-type]
        reasons.append(
            f"jack-knife {quality['jack_knife_mm']:.2f} mm against stated {stated:.2f} mm: a few views decide"
        )
    return reasons


def explain(views: Views, noise: RobotNoise) -> list[str]:
    """Which usual mistake makes the contradiction go away? CalibrationError never: data that fit nothing say so."""
    for spoiled, words in MISTAKES:
        try:
            found = solve(spoiled(views), noise)
        except np.linalg.LinAlgError:
            continue
        if found.chi2_dof < GROSS:
            return [words]
    return square_size(views, noise) or [
        "look for a board that slipped on the flange, poses taken in motion, pictures and poses out of order"
    ]


def _stretched(T: np.ndarray, factor: float) -> np.ndarray:
    return pose(T[:, :3, :3], factor * T[:, :3, 3])


MISTAKES: tuple[tuple[Callable[[Views], Views], str], ...] = (
    (
        lambda v: replace(v, flange=inverse(v.flange)),  # a camera on the flange obeys the same equation
        "swapped frames: the poses fit as T_flange_base; T_base_flange is needed, and the board on the flange",
    ),
    (
        lambda v: replace(v, flange=_stretched(v.flange, 1e-3)),
        "wrong units: the robot's poses are millimetres; metres are needed",
    ),
    (
        lambda v: replace(v, flange=_stretched(v.flange, 1e3)),
        "wrong units: the robot's poses are 1000 times too small; metres are needed",
    ),
)


def with_square(views: Views, sigma: float) -> Views:
    """The board's size as one more unknown that all views share, known to the share `sigma`."""
    column = np.zeros((len(views), 6, 1))
    column[:, :3, 0] = sigma * views.board[:, :3, 3]
    return replace(views, lens=np.concatenate([views.lens, column], 2))


def square_size(views: Views, noise: RobotNoise) -> list[str]:
    """The robot's motion measures the board: the reason against a square size that it contradicts."""
    found = solve(with_square(views, WIDE), noise)
    error, sigma = WIDE * float(found.shared[-1]), WIDE * float(found.shared_sigma[-1])
    if found.chi2_dof > GROSS or abs(error) < MOST_SQUARE * np.hypot(sigma, SQUARE_SIGMA):
        return []
    size = f"the robot's motion says {1 - error:.4f} +- {sigma:.4f} of the square size given"
    return [f"wrong square size: {size}; measure the print over many squares"]
