"""Landmarks of people in a picture -> their limbs as capsules, through the depth of the same pixels. Pure.

The depth layer finds the people, each is shown to the estimator alone: in a picture of several it finds one or two. A
landmark lies at the depth of the surface there, a radius behind it. One with no foreground under it, or as far from
its person as nobody reaches, is dropped, and so is a limb that is too long. How visible an estimator calls a landmark
is not asked: it made up wrists behind backs, and a hip outside of the picture with 0.94.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from asc_rt.faults import FaultsError
from asc_rt.perception.grid import NOISE_SIGMAS, depth_sigma
from drivers.cameras.base import Depth, Image, Intrinsics

PEOPLE = 5  # of one picture, the largest first: each takes 20 ms
LEAST_AREA = 0.05  # m2 of seen surface: head and shoulders
EDGE = 0.05  # m from a pixel to its neighbour, or 4 sigma: one stands before the other. Parts the five of the tests
FRAME = 0.05  # of its height, left around a person
PATCH = 2  # px each way: the depth of a landmark is the median of what is foreground there
LEAST_PIXELS = 5  # of the patch
ARM = 1.0  # m: a landmark may be so much nearer or farther than the middle of its person
LONGEST = 0.8  # m, of a limb
LANDMARK = 0.08  # m, how far one is off: shoulders of a known picture. MEASURED, by eye
Row = tuple[str, list[float], list[float], float, float]  # name, p0, p1 (m, base frame), radius (m), bound (m)


class Limb(NamedTuple):
    """A capsule between the middles of two sets of landmarks."""

    name: str
    a: tuple[str, ...]
    b: tuple[str, ...]
    radius: float  # m. ASSUMED: a large adult in working clothes


def _pair(name: str, a: str, b: str, radius: float) -> tuple[Limb, Limb]:
    left, right = (Limb(f"{side} {name}", (f"{side} {a}",), (f"{side} {b}",), radius) for side in ("left", "right"))
    return left, right


SHOULDERS, HIPS, EARS = ("left shoulder", "right shoulder"), ("left hip", "right hip"), ("left ear", "right ear")
LIMBS = (
    *_pair("hand", "wrist", "index", 0.06),
    *_pair("forearm", "elbow", "wrist", 0.06),
    *_pair("upper arm", "shoulder", "elbow", 0.08),
    Limb("head", EARS, EARS, 0.14),
    Limb("torso", SHOULDERS, HIPS, 0.20),
    *_pair("thigh", "hip", "knee", 0.12),
    *_pair("shin", "knee", "ankle", 0.08),
)


class Found(NamedTuple):
    """What was found in one frame; m = number of limbs, none too large or too far for a person before a camera."""

    camera: int
    t_ns: int  # its capture
    names: tuple[str, ...]
    p0: np.ndarray  # (m, 3) m, base frame
    p1: np.ndarray
    radius: np.ndarray  # (m,) m
    bound: np.ndarray  # (m,) m, at the capture


class PoseError(FaultsError):
    """No pose estimator may be used as it is asked for; each line says what to do."""


class Landmark(NamedTuple):
    name: str  # as in LIMBS; another one is passed over
    u: float  # px of the picture it was found in
    v: float


class PoseEstimator(Protocol):
    """A backend. It runs in a process of its own, without a network; whatever it does ends there."""

    def __init__(self, model: Path) -> None:
        """PoseError: it is not installed, or `model` is none of its models."""

    @property
    def version(self) -> str:
        """Of whose code it is."""

    def estimate(self, image: Image) -> Sequence[Landmark]:
        """Of one person; empty: there is none."""


class Scene(NamedTuple):
    """What a camera is to see through its depth."""

    lens: Intrinsics
    rays: np.ndarray  # (height, width, 3) direction of each pixel, z = 1
    unit: float  # m per count
    T: np.ndarray  # (4, 4) camera to base
    far: np.ndarray  # (height, width) counts: what is nearer stands before the background; 0: none is known
    bound: float  # m, of the camera's calibration


class Person(NamedTuple):
    rows: slice
    columns: slice
    z: float  # m, of its middle


def found(depth: Depth, image: Image, scene: Scene, estimator: PoseEstimator) -> list[Row]:
    """The limbs of all people in one frame. Raises what the estimator raises."""
    foreground = (depth > 0) & (depth < scene.far)
    z = np.where(foreground, depth * scene.unit, 0.0)
    rows = list[Row]()
    for person in people(z, scene.lens):
        seen = estimator.estimate(np.ascontiguousarray(image[person.rows, person.columns]))
        rows += _limbs(lifted(seen, person, z), scene)
    return rows


def people(z: np.ndarray, lens: Intrinsics) -> list[Person]:
    """`z` (height, width) m, of the foreground, else 0. Who stands before somebody else is another one."""
    kernel = np.ones((3, 3), np.uint8)
    nearest, farthest = cv2.erode(np.where(z > 0, z, np.inf), kernel), cv2.dilate(z, kernel)
    whole = (z > 0) & (farthest - nearest < np.maximum(EDGE, 4.0 * depth_sigma(z)))
    count, label, box, _ = cv2.connectedComponentsWithStats(whole.astype(np.uint8), connectivity=4)
    area = np.bincount(label.ravel(), (z * z).ravel(), count) / (lens.fx * lens.fy)
    area[0] = 0.0  # all that is nobody
    largest = [i for i in np.argsort(-area)[:PEOPLE] if area[i] >= LEAST_AREA]
    return [_person(box[i], float(np.median(z[label == i])), z.shape) for i in largest]


def _person(box: np.ndarray, z: float, shape: tuple[int, ...]) -> Person:
    left, top, width, height = (int(n) for n in box[:4])
    more = round(FRAME * height)
    rows = slice(max(top - more, 0), min(top + height + more, shape[0]))
    return Person(rows, slice(max(left - more, 0), min(left + width + more, shape[1])), z)


def lifted(landmarks: Iterable[Landmark], person: Person, z: np.ndarray) -> dict[str, tuple[int, int, float]]:
    """Name -> (row, column, m to the surface) of those that lie on their person."""
    height, width = z.shape
    out = {}
    for name, u, v in landmarks:
        u, v = u + person.columns.start, v + person.rows.start
        if not (0 <= u <= width - 1 and 0 <= v <= height - 1):  # NaN is nowhere
            continue
        row, column = round(v), round(u)
        patch = z[max(row - PATCH, 0) : row + PATCH + 1, max(column - PATCH, 0) : column + PATCH + 1]
        near = patch[(patch > 0) & (np.abs(patch - person.z) < ARM)]
        if near.size >= LEAST_PIXELS:
            out[name] = row, column, float(np.median(near))
    return out


def _limbs(surface: dict[str, tuple[int, int, float]], scene: Scene) -> list[Row]:
    def middle(names: tuple[str, ...], radius: float) -> np.ndarray:
        points = []
        for row, column, z in (surface[name] for name in names):
            ray = scene.rays[row, column]
            points.append(ray * z + ray / np.linalg.norm(ray) * radius)
        return np.asarray(scene.T[:3, :3] @ np.mean(points, 0) + scene.T[:3, 3])

    rows = list[Row]()
    for name, a, b, radius in LIMBS:
        if not surface.keys() >= {*a, *b}:
            continue
        p0, p1 = middle(a, radius), middle(b, radius)
        if np.linalg.norm(p1 - p0) <= LONGEST:
            farthest = max(surface[end][2] for end in (*a, *b))
            bound = scene.bound + LANDMARK + NOISE_SIGMAS * float(depth_sigma(np.array(farthest)))
            rows.append((name, p0.tolist(), p1.tolist(), radius, bound))
    return rows
