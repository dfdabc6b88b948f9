"""Google's pose landmarker (BlazePose, 33 landmarks) through mediapipe's task API: extra `pose`.

It sends its maker figures of its use, without a switch for it (seen: 1.2.3 asks for play.googleapis.com): it runs where
there is no network, see `process`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from asc_rt.perception.pose.limbs import Landmark, PoseError
from drivers.cameras.base import Image

NAMES = {  # DATASHEET: index in its list of 33, left side; the right one is the next
    7: "ear", 11: "shoulder", 13: "elbow", 15: "wrist", 19: "index", 23: "hip", 25: "knee", 27: "ankle",
}  # fmt: skip


class MediaPipe:
    def __init__(self, model: Path) -> None:
        try:
            import mediapipe
            from mediapipe.tasks.python import BaseOptions, vision
        except ImportError as error:
            raise PoseError([f"mediapipe: {error}; uv sync --extra pose"]) from error
        options = vision.PoseLandmarkerOptions(base_options=BaseOptions(model_asset_path=str(model)))
        try:
            self._landmarker: Any = vision.PoseLandmarker.create_from_options(options)
        except Exception as error:  # of any kind: a file that is none of its models is a FileNotFoundError
            said = str(error).splitlines()[0] if str(error) else type(error).__name__
            wanted = "name a .task file of its pose landmarker"
            raise PoseError([f"{model}: no model that mediapipe takes: {said}; {wanted}"]) from error
        self._mediapipe = mediapipe
        self.version = f"mediapipe {mediapipe.__version__}"

    def estimate(self, image: Image) -> list[Landmark]:
        colours = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        mp = self._mediapipe
        seen = self._landmarker.detect(mp.Image(image_format=mp.ImageFormat.SRGB, data=colours)).pose_landmarks
        if not seen:
            return []
        height, width = image.shape[:2]
        return [
            Landmark(f"{side} {name}", seen[0][i].x * width - 0.5, seen[0][i].y * height - 0.5)
            for at, name in NAMES.items()
            for i, side in ((at, "left"), (at + 1, "right"))
        ]
