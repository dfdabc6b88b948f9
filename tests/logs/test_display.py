"""A recording opens in viewers that know nothing of us: their own loaders are asked."""

import dataclasses
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
from mcap.reader import make_reader

from asc_rt.core.types import Mode, StopReason
from logs import schema
from logs.context import attachments, session
from logs.display import Display, about, frames, product
from logs.session_files import SessionFiles

T0_NS, PERIOD_NS = 5_000_000_000, 8_000_000


@pytest.fixture
def drawn(recording: Any, tmp_path: Path) -> tuple[Path, list[Any]]:
    cycles = recording.cycles(40)
    display = Display(recording.params, recording.layout)
    files = SessionFiles(tmp_path / "a.mcap", attachments(recording.cell), session(recording.cell), begin=display.begin)
    for k, record in enumerate(recording.packed(cycles)):
        files.message(schema.CYCLE, T0_NS + k * PERIOD_NS, record)
        display.cycle(files.log, T0_NS + k * PERIOD_NS, record)
    files.close({"reason": "session closed"})
    return tmp_path / "a.mcap", cycles


def messages(path: Path, topic: str) -> list[Any]:
    with open(path, "rb") as file:
        return [(s, c, m) for s, c, m in make_reader(file).iter_messages(topic, log_time_order=False)]


def quaternion_matrix(x: float, y: float, z: float, w: float) -> Any:
    return pinocchio.Quaternion(w, x, y, z).toRotationMatrix()


def test_the_frames_are_those_of_the_model(recording: Any) -> None:
    """Chained from the base they lead to where Pinocchio puts every joint."""
    urdf, names = recording.params.robot.urdf, recording.params.robot.joints
    model = pinocchio.buildModelFromXML(urdf)
    data = model.createData()
    q = np.array([0.3, -0.7, 0.5, 1.1, -0.9, 2.0])
    pinocchio.forwardKinematics(model, data, q)
    places: dict[str, Any] = {"base": (np.eye(3), np.zeros(3))}
    for frame in frames(urdf):
        angle = q[names.index(frame.joint)] if frame.joint in names else 0.0
        rotation, origin = places[frame.parent]
        turned = quaternion_matrix(*product(frame.rotation, about(frame.axis, angle)))
        places[frame.child] = rotation @ turned, origin + rotation @ np.array(frame.translation)
        if frame.joint in names:
            true = data.oMi[model.getJointId(frame.joint)]
            assert np.allclose(places[frame.child][0], true.rotation, atol=1e-12)
            assert np.allclose(places[frame.child][1], true.translation, atol=1e-12)


def test_the_tree_of_frames_is_connected(recording: Any) -> None:
    found = frames(recording.params.robot.urdf)
    known = {"base"}
    for frame in found:
        assert frame.parent in known
        known.add(frame.child)
    assert recording.params.robot.flange in known


def test_transforms_and_joint_states_tell_the_measured_pose(drawn: tuple[Path, list[Any]], recording: Any) -> None:
    path, cycles = drawn
    poses = [schema.FrameTransforms.FromString(m.data) for _, _, m in messages(path, "/tf")]
    joints = [m for _, _, m in messages(path, "/joint_states")]
    assert len(poses) == len(joints) == 8  # 30 Hz of 40 cycles of 8 ms
    moving = {f.joint: i for i, f in enumerate(frames(recording.params.robot.urdf))}
    for k, (pose, joint) in enumerate(zip(poses, joints, strict=True)):
        state = cycles[5 * k][1].joint
        told = pose.transforms[moving[recording.params.robot.joints[1]]]
        fixed = frames(recording.params.robot.urdf)[moving[recording.params.robot.joints[1]]]
        want = product(fixed.rotation, about(fixed.axis, state.q[1]))
        assert np.allclose([told.rotation.x, told.rotation.y, told.rotation.z, told.rotation.w], want)
        assert told.timestamp.ToNanoseconds() == joint.log_time
        assert struct.pack("<6d", *state.q) in joint.data
        assert struct.pack("<6d", *state.dq) in joint.data
        assert struct.pack("<6d", *state.current) in joint.data
        assert all(name.encode() in joint.data for name in recording.params.robot.joints)


def test_changes_of_mode_are_log_lines(drawn: tuple[Path, list[Any]]) -> None:
    lines = [schema.parse_log_message(m.data) for _, _, m in messages(drawn[0], "/log")]
    assert lines == [("INFO", Mode.HOLD.name), ("INFO", "HOLD -> ACTIVE")]


def test_a_stop_is_a_warning_with_its_reason(recording: Any, tmp_path: Path) -> None:
    display = Display(recording.params, recording.layout)
    files = SessionFiles(tmp_path / "a.mcap", attachments(recording.cell), session(recording.cell))
    data = bytearray(recording.packed(recording.cycles(2))[1])
    data[recording.layout.dtype.fields["state.mode"][1]] = Mode.STOPPING
    data[recording.layout.dtype.fields["state.reason"][1]] = StopReason.HUMAN_STALE
    display.cycle(files.log, T0_NS, bytes(data))
    files.close({})
    ((_, _, message),) = messages(tmp_path / "a.mcap", "/log")
    assert schema.parse_log_message(message.data) == ("WARNING", "STOPPING (HUMAN_STALE)")


def test_rerun_draws_it_without_any_code_of_ours(drawn: tuple[Path, list[Any]], tmp_path: Path) -> None:
    rerun, target = Path(sys.executable).with_name("rerun"), tmp_path / "a.rrd"
    done = subprocess.run(
        [str(rerun), "mcap", "convert", str(drawn[0]), "-o", str(target)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    shown = subprocess.run([str(rerun), "rrd", "print", str(target)], capture_output=True, text=True).stdout
    columns = dict(line.split(" - data columns: ") for line in shown.splitlines() if " - data columns: [Tran" in line)
    assert any("/tf" in name for name in columns)
    for wanted in (
        "/joint_states/position - data columns: [Scalars",
        "visual_geometries/j3/visual_0 - data columns: [",
        "/log - data columns: [TextLog",
        "/cell/cycle - data columns: [asc.v1.CycleRecord:message",
    ):
        assert wanted in shown, wanted


def test_meta_data_and_attachments_are_complete(drawn: tuple[Path, list[Any]]) -> None:
    with open(drawn[0], "rb") as file:
        reader = make_reader(file)
        names = {a.name: a.data for a in reader.iter_attachments()}
        told = {m.name: m.metadata for m in reader.iter_metadata()}
    assert {"params.json", "cell.toml", "lrmate_200id.urdf", "fingerprint.json", "packages.txt", "clock.json"} <= set(
        names
    )
    assert b"name" in names["profile.toml"] and b"mass_kg" in names["tool.toml"]
    assert b"numpy==" in names["packages.txt"]
    assert {"operator", "git_commit", "host", "cell", "session_id"} <= set(told["session"])


def test_every_file_that_the_cell_names_is_attached_and_no_secret(recording: Any, tmp_path: Path) -> None:
    (tmp_path / "eye.json").write_text("hand-eye")
    (tmp_path / "log.key").write_text("secret")
    text = '[human]\ncalibration = "eye.json"\n[driver]\nname = "x"\ntable = "missing.csv"\n[log]\nkey = "log.key"\n'
    cell = dataclasses.replace(recording.cell, path=tmp_path / "cell.toml", text=text, overrides=())
    found = attachments(cell)
    assert found["human.calibration"] == b"hand-eye"
    assert b"secret" not in found.values() and "driver.table" not in found
    other = tmp_path / "other.json"
    other.write_text("newer")
    found = attachments(dataclasses.replace(cell, overrides=(f"human.calibration={other}",)))
    assert found["human.calibration"] == b"newer"


def test_meshes_of_the_arm_are_attached(recording: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = recording.params.robot
    monkeypatch.setattr("logs.context.ROBOTS", tmp_path)
    (tmp_path / robot.name / "meshes").mkdir(parents=True)
    (tmp_path / robot.name / "meshes/a.stl").write_bytes(b"shape")
    urdf = robot.urdf.replace(
        "</robot>",
        '<link name="m"><visual><geometry><mesh filename="meshes/a.stl"/></geometry></visual></link></robot>',
    )
    params = dataclasses.replace(recording.params, robot=dataclasses.replace(robot, urdf=urdf))
    assert attachments(dataclasses.replace(recording.cell, params=params))["mesh/meshes/a.stl"] == b"shape"
