"""Cycle records -> what the viewer draws, in columns: one call per entity and block of records, no loop over cycles.

The arm in full colour is the measured one. The translucent capsules are what the decision was about: the arm at its
set-point and the people where they may be one command latency ahead; the lines between them are the recorded pairs.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from asc_rt.core import robot_model
from asc_rt.core.params import Params
from asc_rt.core.types import Basis
from logs.view_geometry import Segments, connecting_lines, poses, robot_segments
from logs.view_layout import APPLICATION, BLUE, FLOOR_Z, ORANGE, TIMELINE, log_styles, phi_colours

Array = np.ndarray[Any, Any]
Records = np.ndarray[Any, np.dtype[np.void]]

PNG_GREY_16 = b"\x10\x00"  # bit depth and colour type in the header
ROWS = 1000  # cycles in one block
MONITOR = ("distance", "protective_distance")
DECISION, PAIRS, HUMAN = "outputs.decision", "outputs.decision.pairs", "inputs.human"
PERSON, TOOL_COLOUR, PEDESTAL = (214, 158, 120, 255), (200, 70, 60, 255), (58, 60, 66, 255)
JUDGED_ARM, JUDGED_PERSON = (*BLUE, 45), (*ORANGE, 50)
NEAREST_RADIUS, PAIR_RADIUS = -4.0, -1.0  # negative: pixels of the screen


def in_blocks(batches: Iterable[Records], rows: int = ROWS) -> Iterator[Records]:
    """The same records in blocks, each beginning with the last record of the one before: so that a cycle can be drawn
    together with the one that follows."""
    waiting: list[Records] = []
    for batch in batches:
        waiting.append(batch)
        if sum(map(len, waiting)) > rows:
            block = np.concatenate(waiting)
            yield block
            waiting = [block[-1:]]
    if sum(map(len, waiting)) > 1:
        yield np.concatenate(waiting)


class Canvas:
    """One recording for the viewer, filled block by block."""

    def __init__(self, recording: rr.RecordingStream, params: Params, t0_ns: int, scene_stride: int = 1) -> None:
        """`t0_ns`: moment 0 of the time axis. `scene_stride`: of so many cycles the scene shows one, the nearest."""
        rr.set_strict_mode(True)  # nothing of a picture is left out silently
        self.recording, self.params, self._t0_ns, self._stride = recording, params, t0_ns, scene_stride
        self._model = robot_model.load(params.robot, params.tool)
        self._latency = params.robot.command_latency_ns * 1e-9
        self._joints = self._draw_robot()
        log_styles(recording, params.robot.joints)

    # --- once --------------------------------------------------------------------------------------------------------

    def _draw_robot(self) -> list[rr.urdf.UrdfJoint]:
        """Arm and tool, which do not change their shape; the joints that move them."""
        robot = self.params.robot
        with tempfile.TemporaryDirectory() as folder:  # the viewer's loader reads files only
            path = Path(folder, f"{robot.name}.urdf")
            path.write_text(robot.urdf)
            tree = rr.urdf.UrdfTree.from_file_path(path, "arm", static_transform_entity_path="tf_static")
            tree.log_urdf_to_recording(self.recording)
            for chunk in tree.stream(include_joint_transforms=False):
                names = chunk.to_record_batch().schema.names
                for shape in (rr.Boxes3D, rr.Cylinders3D):  # drawn with edges unless told otherwise
                    if any(name.startswith(shape.__name__) for name in names):
                        self.recording.log(chunk.entity_path, shape.from_fields(fill_mode="solid"), static=True)
        found = {joint.name: joint for joint in tree.joints()}
        if specs := self.params.tool.capsules:
            p0, p1 = (np.array([[getattr(c, end) for c in specs]]) for end in ("p0", "p1"))
            at = poses(Segments(p0, p1, np.zeros((1, len(specs)))))
            self.recording.log("cell/tool", rr.CoordinateFrame(robot.flange), static=True)
            solid = rr.Capsules3D(
                lengths=at.length[0],
                radii=[0.8 * c.radius for c in specs],  # a little inside the capsule that is judged
                translations=at.origin[0],
                quaternions=at.quaternion[0],
                colors=TOOL_COLOUR,
                fill_mode="solid",
            )
            self.recording.log("cell/tool", solid, static=True)
        base = rr.Cylinders3D(
            lengths=-FLOOR_Z, radii=0.09, centers=[0.0, 0.0, FLOOR_Z / 2], colors=PEDESTAL, fill_mode="solid"
        )
        self.recording.log("cell/pedestal", rr.CoordinateFrame("base"), base, static=True)
        for entity in ("cell/judged/arm", "cell/judged/person", "cell/person", "cell/pairs", "cell/nearest"):
            self.recording.log(entity, rr.CoordinateFrame("base"), static=True)
        return [found[name] for name in robot.joints]

    # --- every block -------------------------------------------------------------------------------------------------

    def time(self, t_ns: Array) -> rr.TimeColumn:
        return rr.TimeColumn(TIMELINE, duration=(t_ns - self._t0_ns).astype("timedelta64[ns]"))

    def image(self, entity: str, t_ns: int, form: str, data: bytes) -> None:
        """`form`: "png" with 16 bits of grey is depth in mm; anything else is what it looks like."""
        self.recording.set_time(TIMELINE, duration=(t_ns - self._t0_ns) * 1e-9)
        if form == "png" and data[24:26] == PNG_GREY_16:
            self.recording.log(entity, rr.EncodedDepthImage(data, media_type="image/png", meter=1000.0))
        else:
            self.recording.log(entity, rr.EncodedImage(contents=data, media_type=f"image/{form}"))

    def draw(self, now: Records, following: Records) -> None:
        """Scene and plots of the cycles `now`; `following`: the cycle after each of them."""
        self._draw_scene(self._thinned(now))
        self._draw_plots(now)
        sent = following["state.ddq_cmd"]  # what a cycle sends is the state that the next one begins with
        controls = np.stack([now[f"{DECISION}.u_ref"], now[f"{DECISION}.u_safe"], sent], axis=-1)
        for i, joint in enumerate(self.params.robot.joints):
            self._send_scalars(f"plot/u/{joint}", now["inputs.t_ns"], controls[:, i])

    def _thinned(self, now: Records) -> Records:
        """Of every `scene_stride` cycles the one with the least distance: what matters is always among them."""
        if self._stride == 1:
            return now
        distance = now[f"{DECISION}.d_measured"]
        ends = range(0, len(now), self._stride)
        return now[[start + int(distance[start : start + self._stride].argmin()) for start in ends]]

    def _draw_scene(self, now: Records) -> None:
        heard = now[now["inputs.joint.present"] == 1]
        if len(heard):
            for i, joint in enumerate(self._joints):
                columns = joint.compute_transform_columns(heard["inputs.joint.q"][:, i].tolist(), clamp=False)
                self.recording.send_columns(f"tf/{joint.name}", [self.time(heard["inputs.t_ns"])], columns)
        present = np.where(now[f"{HUMAN}.present"] == 1, now[f"{HUMAN}.count"], 0)
        self._send_capsules("cell/person", now, seen_people(now), present, PERSON)
        people = judged_people(now, self._latency)
        self._send_capsules("cell/judged/person", now, people, present, JUDGED_PERSON)
        arm = robot_segments(self._model, now["state.q_cmd"])
        all_of_it = np.where(now["inputs.joint.present"] == 1, arm.p0.shape[1], 0)
        self._send_capsules("cell/judged/arm", now, arm, all_of_it, JUDGED_ARM)
        self._send_pairs(now, arm, people)

    def _send_capsules(
        self, entity: str, now: Records, segments: Segments, count: Array, colour: tuple[int, int, int, int]
    ) -> None:
        """The first `count` capsules of each cycle."""
        used = np.arange(segments.radius.shape[1]) < count[:, None]
        at = poses(segments)
        columns = rr.Capsules3D.columns(
            lengths=at.length[used].astype(np.float32),
            radii=segments.radius[used].astype(np.float32),
            translations=at.origin[used].astype(np.float32),
            quaternions=at.quaternion[used].astype(np.float32),
        )
        self.recording.log(entity, rr.Capsules3D.from_fields(colors=colour, fill_mode="solid"), static=True)
        self.recording.send_columns(entity, [self.time(now["inputs.t_ns"])], columns.partition(count))

    def _send_pairs(self, now: Records, arm: Segments, people: Segments) -> None:
        count = now[f"{PAIRS}.count"]
        k = max(int(count.max(initial=0)), 1)
        robot, human = (now[f"{PAIRS}.{side}"][:, :k].astype(np.intp) for side in ("robot", "human"))
        used = np.arange(k) < count[:, None]
        robot, human = np.where(used, robot, 0), np.where(used, human, 0)
        lines = connecting_lines(arm.take(robot), people.take(human)).astype(np.float32)
        colours = phi_colours(now[f"{PAIRS}.phi"][:, :k])
        first, rest = used & (np.arange(k) == 0), used & (np.arange(k) > 0)
        at = [self.time(now["inputs.t_ns"])]
        for entity, shown in (("cell/nearest", first), ("cell/pairs", rest)):
            columns = [*rr.LineStrips3D.columns(strips=lines[shown], colors=colours[shown]).partition(shown.sum(1))]
            if entity == "cell/nearest":
                distance = np.char.add(np.char.mod("%.3f", now[f"{PAIRS}.d"][:, 0][count > 0]), " m")
                columns += rr.LineStrips3D.columns(labels=distance.tolist()).partition(shown.sum(1))
            self.recording.send_columns(entity, at, columns)
        self.recording.log("cell/nearest", rr.LineStrips3D.from_fields(radii=NEAREST_RADIUS), static=True)
        self.recording.log("cell/pairs", rr.LineStrips3D.from_fields(radii=PAIR_RADIUS), static=True)

    def _draw_plots(self, now: Records) -> None:
        t_ns, safety, some = now["inputs.t_ns"], self.params.safety, now[f"{PAIRS}.count"] > 0
        heard = now[f"{HUMAN}.present"] == 1
        measured = now[f"{DECISION}.d_measured"]
        watched = (now[f"{DECISION}.monitor.present"] == 1) & np.isfinite(now[f"{DECISION}.monitor.distance"])
        nearest = {name: np.where(some, now[f"{PAIRS}.{name}"][:, 0], np.nan) for name in ("d", "d_dot", "M", "M_dot")}
        for name in ("M", "M_dot"):  # a gap where they were not evaluated
            nearest[name] = np.where(now[f"{PAIRS}.basis"][:, 0] == Basis.FREE, np.nan, nearest[name])
        listed = np.arange(now[f"{PAIRS}.phi"].shape[1]) < now[f"{PAIRS}.count"][:, None]
        worst = np.where(listed, now[f"{PAIRS}.phi"], -np.inf).max(axis=1)
        age = np.where(heard, now["inputs.human_age_ns"] * 1e-6, np.nan)
        busy = (now["timings.t_write_end_ns"] - now["timings.t_wake_ns"]) * 1e-6
        limit, period = self.params.human.age_limit_ns * 1e-6, self.params.period_ns * 1e-6
        for entity, *series in (
            ("distance", np.where(np.isfinite(measured), measured, np.nan), nearest["d"], safety.d_min),
            ("phi", np.where(some, worst, np.nan), 0.0),
            ("d_dot", nearest["d_dot"], 0.0),
            ("M", nearest["M"], safety.M_floor),
            ("M_dot", nearest["M_dot"]),
            ("age", age, limit),
            ("monitor", *(np.where(watched, now[f"{DECISION}.monitor.{name}"], np.nan) for name in MONITOR)),
            ("cycle", busy, period),
        ):
            columns = [np.broadcast_to(np.asarray(values, float), len(now)) for values in series]
            self._send_scalars(f"plot/{entity}", t_ns, np.stack(columns, axis=-1))

    def _send_scalars(self, entity: str, t_ns: Array, values: Array) -> None:
        """`values` (r, k): k series that share one entity."""
        columns = rr.Scalars.columns(scalars=values.ravel()).partition(np.full(len(values), values.shape[1]))
        self.recording.send_columns(entity, [self.time(t_ns)], columns)


def seen_people(now: Records) -> Segments:
    """As the sensor saw them, at capture, without bounds."""
    return Segments(now[f"{HUMAN}.p0"], now[f"{HUMAN}.p1"], now[f"{HUMAN}.radius"])


def judged_people(now: Records, latency_s: float) -> Segments:
    """Where they may be one command latency from now: see `asc_rt.core.people.predict`."""
    horizon = (now["inputs.human_age_ns"] * 1e-9 + latency_s)[:, None]
    p0, p1 = (now[f"{HUMAN}.p{i}"] + horizon[..., None] * now[f"{HUMAN}.v{i}"] for i in (0, 1))
    grown = now[f"{HUMAN}.position_bound"] + np.abs(horizon) * now[f"{HUMAN}.velocity_bound"]
    return Segments(p0, p1, now[f"{HUMAN}.radius"] + grown)


def new_recording(name: str) -> rr.RecordingStream:
    recording = rr.RecordingStream(APPLICATION, recording_id=name)
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    return recording
