"""Small recordings for the cameras that play files."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from asc_rt.config import load_cell
from drivers.cameras.azure import BROWN
from logs import schema
from logs.context import attachments, session
from logs.log_file import LogFile

Shots = Iterable[tuple[int, np.ndarray]]  # (stamp of the device ns, counts)


def write_mcap(path: Path, shots: Shots, name: str = "left", lens: dict[str, Any] | None = None) -> str:
    """A session with the pictures of one camera and its `lens`, if any."""
    told = []
    if lens is not None:
        data = schema.CameraCalibration(frame_id=name, **lens).SerializeToString()
        told.append((schema.camera_calibration(data), data))
    for t_ns, counts in shots:
        png = cv2.imencode(".png", counts)[1].tobytes() if counts.size else b""
        image = schema.CompressedImage(frame_id=name, format="png", data=png)
        image.timestamp.FromNanoseconds(t_ns)
        told.append((schema.camera(data := image.SerializeToString()), data))
    return write_log(path, told)


def write_log(path: Path, told: Iterable[tuple[schema.Channel | None, bytes]]) -> str:
    """A session as the logger writes it, with these messages."""
    cell = load_cell("fanuc-sim-truth")
    log = LogFile(path, attachments(cell), session(cell))
    for i, (channel, data) in enumerate(told):
        assert channel is not None
        log.message(channel, i, data)
    log.close({"reason": "session closed"})
    return str(path)


def factory_calibration(lens: Sequence[float], serial: str = "S1", model: str = BROWN) -> bytes:
    """`lens`: cx cy fx fy of the square as 1 x 1."""
    inner = {"ModelParameters": [*lens, *[0] * 10], "ModelType": model}
    depth = {"Purpose": "CALIBRATION_CameraPurposeDepth", "Intrinsics": inner}
    told = {"Cameras": [depth], "Metadata": {"SerialId": serial}}
    return json.dumps({"CalibrationInformation": told}).encode() + b"\0"


def write_mkv(path: Path, shots: Shots, calibration: bytes, mode: str = "NFOV_UNBINNED", start_ns: int = 0) -> str:
    """As k4arecorder writes them, the depth alone. Stamps: whole ms after `start_ns`."""
    import av

    with av.open(str(path), "w", format="matroska", options={"allow_raw_vfw": "1"}) as out:
        out.metadata.update({"K4A_DEVICE_SERIAL_NUMBER": "S1", "K4A_START_OFFSET_NS": str(start_ns)})
        stream, shots = out.add_stream("rawvideo", rate=30), list(shots)
        stream.height, stream.width = shots[0][1].shape
        stream.pix_fmt, stream.time_base, stream.codec_context.codec_tag = "gray16be", Fraction(1, 1000), "b16g"
        stream.metadata["K4A_DEPTH_MODE"] = mode
        attached = out.add_attachment("calibration.json", "application/octet-stream", calibration)
        attached.metadata["K4A_CALIBRATION_FILE"] = "calibration.json"
        for t_ns, counts in shots:
            packet = av.Packet(counts.astype(">u2").tobytes())
            packet.stream, packet.time_base, packet.is_keyframe = stream, stream.time_base, True
            packet.pts = packet.dts = (t_ns - start_ns) // 1_000_000
            out.mux(packet)
    return str(path)
