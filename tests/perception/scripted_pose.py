"""Estimators for the tests: they have no model and see nobody, but say what they are told to."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from asc_rt.perception.pose.limbs import LIMBS, Landmark, PoseError

ENDS = sorted({name for limb in LIMBS for name in (*limb.a, *limb.b)})


class Good:
    """Every landmark in the middle of the picture."""

    version = "scripted 1"

    def __init__(self, model: Path) -> None:
        self.model, self.asked = model, 0

    def estimate(self, image: np.ndarray) -> Sequence[Landmark]:
        self.asked += 1
        height, width = image.shape[:2]
        return [Landmark(name, (width - 1) / 2, (height - 1) / 2) for name in ENDS]


class RaisesOnce(Good):
    def estimate(self, image: np.ndarray) -> Sequence[Landmark]:
        if not self.asked:
            self.asked += 1
            raise RuntimeError("the graph has errors")
        return super().estimate(image)


class Hangs(Good):
    def estimate(self, image: np.ndarray) -> Sequence[Landmark]:
        time.sleep(1000.0)
        return []


class Dies(Good):
    def estimate(self, image: np.ndarray) -> Sequence[Landmark]:
        os.abort()


class Chatters(Good):
    def estimate(self, image: np.ndarray) -> Sequence[Landmark]:
        print('{"limbs": [["head", [0, 0, 0], [0, 0, 0], 0.1, 0.1]]}', flush=True)
        os.write(1, b"INFO: Created delegate for CPU.\n")
        return super().estimate(image)


class Refuses(Good):
    def __init__(self, model: Path) -> None:
        raise PoseError([f"{model.name}: no model of ours; name another one"])


class DiesAtOnce(Good):
    def __init__(self, model: Path) -> None:
        os._exit(3)


class AsksTheNetwork(Good):
    """`version` says what came of it."""

    def __init__(self, model: Path) -> None:
        super().__init__(model)
        try:
            socket.create_connection(("127.0.0.1", int(model.name)), 2.0).close()
            self.version = "connected"
        except OSError as error:
            self.version = f"refused: {error.strerror}"
