"""A camera that sees a printed board: rays through a lens, a plane with a picture on it, blur and noise. Own optics.

Brown's lens x_d = x (1 + k1 r2 + k2 r4 + k3 r6) + tangential, inverted by fixed-point iteration; no product code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

OVERSAMPLING = 2  # rays per pixel and axis
BACKGROUND, PAPER = 90.0, 235.0  # grey levels
MARGIN = 0.5  # white border of the print, squares


@dataclass(frozen=True, slots=True)
class Lens:
    width: int = 640
    height: int = 480
    fx: float = 560.0
    fy: float = 562.0
    cx: float = 325.0
    cy: float = 236.0
    distortion: tuple[float, ...] = (-0.12, 0.05, 0.0005, -0.0004, 0.0)  # k1 k2 p1 p2 k3

    def rays(self) -> np.ndarray:
        """(height s, width s, 2) undistorted x/z, y/z of each sample."""
        s = OVERSAMPLING
        u, v = ((np.arange(n * s) + 0.5) / s - 0.5 for n in (self.width, self.height))
        xd, yd = np.meshgrid((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xd, yd
        for _ in range(12):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            x, y = (
                (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
                (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
            )
        return np.stack([x, y], -1)


def render(
    lens: Lens, rays: np.ndarray, T_cam_board: np.ndarray, print_: np.ndarray, square: float, columns: int,
    rng: np.random.Generator, blur: float = 0.6, noise: float = 2.0,
) -> np.ndarray:  # fmt: skip
    """(height, width) uint8: `print_` on a plane, `square` m per printed square; `blur` px, `noise` grey levels."""
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    size = square * np.array([columns, columns * print_.shape[0] / print_.shape[1]])
    s, image = OVERSAMPLING, np.full(rays.shape[:2], BACKGROUND, np.float32)
    part = _around(rays, R, t, size, MARGIN * square)
    image[part] = _paper(rays[part], R, t, print_, print_.shape[1] / columns / square, MARGIN * square)
    image = image.reshape(lens.height, s, lens.width, s).mean((1, 3))
    image = gaussian_filter(image, blur) + noise * rng.normal(size=image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _around(rays: np.ndarray, R: np.ndarray, t: np.ndarray, size: np.ndarray, margin: float) -> tuple[slice, slice]:
    """The part of the picture outside of which no ray meets the paper: all of it, if the paper reaches behind."""
    corners = np.array([[x, y, 0.0] for x in (-margin, size[0] + margin) for y in (-margin, size[1] + margin)])
    p = corners @ R.T + t
    if p[:, 2].min() < 0.05:
        return slice(None), slice(None)
    at = p[:, :2] / p[:, 2:]
    low, high = at.min(0), at.max(0)
    inside = np.all((rays >= low) & (rays <= high), axis=2)
    return tuple(  # type: ignore[return-value]
        slice(int(found[0]), int(found[-1]) + 1) if len(found := np.flatnonzero(inside.any(axis))) else slice(0, 0)
        for axis in (1, 0)
    )


def _paper(
    rays: np.ndarray, R: np.ndarray, t: np.ndarray, print_: np.ndarray, scale: float, margin: float
) -> np.ndarray:
    """Grey levels where each ray meets the plane of the print; `scale`: pixels of the print per metre."""
    normal = R[:, 2]
    depth = (normal @ t) / (rays @ normal[:2] + normal[2])
    at = rays * depth[..., None]
    x, y = ((at - t[:2]) @ R[:2, k] + (depth - t[2]) * R[2, k] for k in (0, 1))
    px, py = x * scale - 0.5, y * scale - 0.5
    border = margin * scale
    h, w = print_.shape
    on_print = (px > -0.5) & (px < w - 0.5) & (py > -0.5) & (py < h - 0.5) & (depth > 0)
    on_paper = (px > -border) & (px < w + border) & (py > -border) & (py < h + border) & (depth > 0)
    image = np.where(on_paper, PAPER, BACKGROUND)
    image[on_print] = map_coordinates(
        print_.astype(np.float32) * (PAPER / 255), [py[on_print], px[on_print]], order=1, mode="nearest"
    )
    return image
