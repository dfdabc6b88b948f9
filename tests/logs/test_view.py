"""The view: what is in the viewer's file is what was recorded, and the viewer itself keeps to this machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pinocchio as pin
import pytest
from rerun.chunk import RrdReader

from asc_rt.core import robot_model
from asc_rt.core.abstraction import separation
from asc_rt.core.people import predict
from asc_rt.core.types import HumanState, Mode, Status, StopReason, vector
from logs.mcap_scan import LogError
from logs.reader import records
from logs.recording import open_recording
from logs.view import view, write_rrd
from logs.view_columns import Canvas, in_blocks, new_recording
from logs.view_events import Event, changes, draw_near_misses, nearest_moments
from logs.view_geometry import Segments, connecting_lines, poses
from logs.view_layout import AMBER, GREEN, RED, layout, phi_colours
from logs.view_live import Painter
from logs.view_process import ViewError
from tests.pairs import ROWS, pairs_of, with_rows

PERIOD_S = 0.008
Edit = Callable[[int, Any, Any, Any], tuple[Any, Any, Any]]


def edited(recording: Any, count: int, edit: Edit) -> list[Any]:
    """Cycles of the made-up session, changed: edit(tick, state, inputs, outputs)."""
    return [(*edit(i, *cycle[:3]), *cycle[3:]) for i, cycle in enumerate(recording.cycles(count))]


def with_decision(outputs: Any, **changed: Any) -> Any:
    return dataclasses.replace(outputs, decision=dataclasses.replace(outputs.decision, **changed))


def rrd_of(recording: Any, tmp_path: Path, cycles: list[Any], **options: Any) -> Path:
    log = open_recording(recording.write(recording.packed(cycles), **options))
    path = tmp_path / "out.rrd"
    write_rrd(log, path, nearest_moments(log).worst_ns)
    return path


def content(rrd: Path) -> dict[str, dict[str, list[Any]]]:
    """entity -> column -> value of every row, in order of time; `t`: seconds."""
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(rrd).stream():
        batch = chunk.to_record_batch()
        columns = found.setdefault(chunk.entity_path.removeprefix("/"), {})
        for name in batch.schema.names:
            if name == "session":
                columns.setdefault("t", []).extend(np.asarray(batch.column(name).cast("int64")) * 1e-9)
            elif "RowId" not in name:
                columns.setdefault(name.rpartition(":")[2], []).extend(batch.column(name).to_pylist())
    return found


def scalars(rows: dict[str, list[Any]]) -> np.ndarray[Any, Any]:
    return np.array(rows["scalars"], float)


# --- the file --------------------------------------------------------------------------------------------------------


def test_the_file_holds_what_the_layout_shows(recording: Any, tmp_path: Path) -> None:
    rrd = rrd_of(recording, tmp_path, recording.cycles(60))
    found = content(rrd)
    plots = {f"plot/{name}" for name in ("distance", "phi", "d_dot", "M", "M_dot", "age", "cycle")}
    joints = recording.params.robot.joints
    scene = {"cell/judged/arm", "cell/judged/person", "cell/person", "cell/pairs", "cell/nearest", "cell/tool"}
    expected = plots | scene | {"state/mode", "state/safety_filter", "events"}
    expected |= {f"plot/u/{joint}" for joint in joints} | {f"tf/{joint}" for joint in joints}
    assert expected <= set(found)
    assert any(name.startswith("arm/") for name in found)  # the shapes of the URDF
    assert RrdReader(rrd).blueprints()
    for name in plots:
        assert found[name]["t"] == pytest.approx(PERIOD_S * np.arange(59))  # the last cycle waits for its successor


def test_plots_are_the_recorded_numbers(recording: Any, tmp_path: Path) -> None:
    def edit(i: int, state: Any, x: Any, out: Any) -> Any:
        state = dataclasses.replace(state, ddq_cmd=vector(np.full(6, 0.1 * i)))
        phi = vector([-0.5, 0.01 * i])  # the nearest pair is not the worst one
        out = with_decision(out, pairs=with_rows(out.decision.pairs, phi=phi))
        return state, x, out

    cycles = edited(recording, 40, edit)
    found = content(rrd_of(recording, tmp_path, cycles))
    decisions = [cycle[2].decision for cycle in cycles[:-1]]
    measured = [d.d_measured if np.isfinite(d.d_measured) else np.nan for d in decisions]
    distance = scalars(found["plot/distance"])
    assert distance[:, 0] == pytest.approx(measured, nan_ok=True)
    assert distance[:, 1] == pytest.approx([d.pairs.d[0] for d in decisions], nan_ok=True)
    assert set(distance[:, 2]) == {recording.params.safety.d_min}
    assert scalars(found["plot/phi"])[:, 0] == pytest.approx([max(d.pairs.phi) for d in decisions])
    control = scalars(found["plot/u/J3"])
    assert control[:, 0] == pytest.approx([d.u_ref[2] for d in decisions])
    assert control[:, 1] == pytest.approx([d.u_safe[2] for d in decisions])
    assert control[:, 2] == pytest.approx(0.1 * np.arange(1, 40))  # what a cycle sends is the next one's state


def test_where_there_is_no_pair_the_plots_have_a_gap(recording: Any, tmp_path: Path) -> None:
    none = pairs_of(**dict.fromkeys(ROWS, ()))
    edit: Edit = lambda i, s, x, out: (s, x, with_decision(out, pairs=none, d_measured=np.inf))  # noqa: E731
    found = content(rrd_of(recording, tmp_path, edited(recording, 10, edit)))
    assert np.isnan(scalars(found["plot/distance"])[:, :2]).all()
    assert np.isnan(scalars(found["plot/phi"])[:, 0]).all()
    assert all(len(strips) == 0 for strips in found["cell/nearest"]["strips"])


def test_the_arm_stands_where_its_joints_were_measured(recording: Any, tmp_path: Path) -> None:
    cycles = recording.cycles(12)
    found = content(rrd_of(recording, tmp_path, cycles))
    model = robot_model.load(recording.params.robot, recording.params.tool).pin_model
    for k in (0, 5, 10):
        placed = pin.SE3.Identity()
        for joint in recording.params.robot.joints:
            at = found[f"tf/{joint}"]
            turn = pin.Quaternion(np.array(at["quaternion"][k][0])).matrix()
            placed = placed * pin.SE3(turn, np.array(at["translation"][k][0], float))
        data = model.createData()
        pin.forwardKinematics(model, data, cycles[k][1].joint.q)
        assert placed.homogeneous == pytest.approx(data.oMi[6].homogeneous, abs=1e-5)


# --- geometry --------------------------------------------------------------------------------------------------------


def random_people(rng: np.random.Generator, m: int, t_ns: int) -> HumanState:
    p0 = rng.uniform([0.3, -0.8, -0.5], [1.2, 0.8, 1.0], size=(m, 3))
    p1 = p0 + rng.normal(scale=0.25, size=(m, 3))
    p1[0] = p0[0]  # a sphere
    v = [vector(rng.normal(scale=0.5, size=(m, 3))) for _ in range(2)]
    bounds = [vector(rng.uniform(0.02, 0.1, size=m)) for _ in range(3)]
    return HumanState(t_ns, 1, 1, 0, 0, 1.0, True, vector(p0), vector(p1), *v, *bounds, np.zeros(m, np.int64))  # type: ignore[arg-type]


def judged_by_the_core(recording: Any, seed: int) -> Edit:
    """Every cycle gets its own arm and people, and the pairs that the core finds for them."""
    params = recording.params
    model = robot_model.load(params.robot, params.tool)

    def edit(i: int, state: Any, x: Any, out: Any) -> Any:
        rng = np.random.default_rng([seed, i])
        q = vector(rng.uniform(-1.2, 1.2, size=6))
        human = random_people(rng, 4, x.t_ns - x.human_age_ns)
        people = predict(human, (x.human_age_ns + params.robot.command_latency_ns) * 1e-9)
        pairs = separation(model.chain, model.capsules, people, q, np.zeros(6), np.inf, 0.0)
        nearest = np.argsort(pairs.d)[:10]
        d = vector(pairs.d[nearest])
        rows = dict.fromkeys(ROWS, d) | {"basis": np.zeros(10), "outside": np.zeros(10)}
        shown = pairs_of(**rows | {"robot": pairs.robot[nearest], "human": pairs.human[nearest]})
        return dataclasses.replace(state, q_cmd=q), dataclasses.replace(x, human=human), with_decision(out, pairs=shown)

    return edit


def distance_to_axis(point: Any, p0: Any, p1: Any) -> float:
    along = p1 - p0
    share = np.clip((point - p0) @ along / max(along @ along, 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(point - p0 - share * along))


def test_lines_join_the_surfaces_and_are_as_long_as_recorded(recording: Any, tmp_path: Path) -> None:
    cycles = edited(recording, 25, judged_by_the_core(recording, 3))
    found = content(rrd_of(recording, tmp_path, cycles))
    params = recording.params
    specs = [*params.robot.capsules, *params.tool.capsules]
    model = robot_model.load(params.robot, params.tool).pin_model
    for k, (state, x, out, *_) in enumerate(cycles[:-1]):
        data = model.createData()
        pin.framesForwardKinematics(model, data, state.q_cmd)
        lines = [*found["cell/nearest"]["strips"][k], *found["cell/pairs"]["strips"][k]]
        pairs = out.decision.pairs
        assert len(lines) == len(pairs.d)
        people = predict(x.human, (x.human_age_ns + params.robot.command_latency_ns) * 1e-9)
        for line, robot, human, d in zip(lines, pairs.robot, pairs.human, pairs.d, strict=True):
            start, end = np.array(line, float)
            spec, frame = specs[robot], data.oMf[model.getFrameId(specs[robot].link)]
            axis = [frame.act(np.array(p)) for p in (spec.p0, spec.p1)]
            assert distance_to_axis(start, *axis) == pytest.approx(spec.radius, abs=1e-5)
            assert distance_to_axis(end, people.p0[human], people.p1[human]) == pytest.approx(
                people.radius[human], abs=1e-5
            )
            assert np.linalg.norm(end - start) == pytest.approx(abs(d), abs=1e-5)
        label = found["cell/nearest"]["labels"][k]
        assert label == [f"{pairs.d[0]:.3f} m"]


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ([[0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 1, 0]]),  # parallel
        ([[0, 0, 0], [1, 0, 0]], [[2, 1, 0], [3, 1, 0]]),  # parallel, side by side
        ([[0, 0, 0], [0, 0, 0]], [[0, 0, 2], [0, 0, 2]]),  # two points
        ([[0, 0, 0], [1, 0, 0]], [[0.3, 0, 1], [0.3, 0, 1]]),  # a point over a segment
        ([[0, 0, 0], [1, 0, 0]], [[0.5, -1, 0.7], [0.5, 1, 0.7]]),  # crossing
    ],
)
def test_nearest_points_of_special_segments(a: list[Any], b: list[Any]) -> None:
    one, other = (Segments(*(np.array(p, float)[None, None] for p in s), np.zeros((1, 1))) for s in (a, b))
    start, end = connecting_lines(one, other)[0, 0]
    grid = np.linspace(0.0, 1.0, 201)[:, None]
    points = [(1 - grid) * np.array(s[0], float) + grid * np.array(s[1], float) for s in (a, b)]
    least = np.linalg.norm(points[0][:, None] - points[1][None], axis=-1).min()
    assert np.linalg.norm(end - start) == pytest.approx(least, abs=1e-9)


def test_poses_turn_z_onto_the_capsule() -> None:
    p1 = np.array([[[0, 0, 2.0], [0, 0, -2.0], [1.0, 2.0, 3.0], [0, 0, 0]]])
    at = poses(Segments(np.zeros((1, 4, 3)), p1, np.ones((1, 4))))
    for i in range(4):
        turned = pin.Quaternion(at.quaternion[0, i]).matrix() @ [0.0, 0.0, at.length[0, i]]
        assert turned == pytest.approx(p1[0, i])


def test_nobody_there_is_drawn_as_nobody(recording: Any, tmp_path: Path) -> None:
    def edit(i: int, state: Any, x: Any, out: Any) -> Any:
        rng = np.random.default_rng(i)
        human = random_people(rng, 2, x.t_ns) if i < 4 else random_people(rng, 2, x.t_ns) if i == 8 else None
        return state, dataclasses.replace(x, human=human), out

    found = content(rrd_of(recording, tmp_path, edited(recording, 12, edit)))
    for entity in ("cell/person", "cell/judged/person"):
        assert [len(row) for row in found[entity]["translations"]] == [2] * 4 + [0] * 4 + [2] + [0] * 2
    assert np.isnan(scalars(found["plot/age"])[5, 0])


# --- colours ---------------------------------------------------------------------------------------------------------


def test_colour_tells_the_sign_of_phi() -> None:
    colours = phi_colours(np.array([-5.0, 0.0, 5.0, np.nan]))
    assert colours[:, :3].tolist() == [list(GREEN), list(AMBER), list(RED), list(RED)]
    safe, unsafe = phi_colours(np.array([-0.05, 0.05]))
    assert safe[0] < AMBER[0]
    assert unsafe[1] < AMBER[1]


def test_lines_carry_the_colour_of_their_phi(recording: Any, tmp_path: Path) -> None:
    edit: Edit = lambda i, s, x, out: (  # noqa: E731
        s, x, with_decision(out, pairs=with_rows(out.decision.pairs, phi=[1.0, -1.0]))
    )  # fmt: skip
    found = content(rrd_of(recording, tmp_path, edited(recording, 8, edit)))
    packed = lambda c: int.from_bytes(bytes((*c, 255)), "big")  # noqa: E731
    assert found["cell/nearest"]["colors"][5] == [packed(RED)]
    assert found["cell/pairs"]["colors"][5] == [packed(GREEN)]


# --- what happened ---------------------------------------------------------------------------------------------------


def dated(recording: Any, distance: list[float], mode: Mode = Mode.ACTIVE) -> list[Any]:
    """One cycle per distance, half a second apart."""

    def edit(i: int, state: Any, x: Any, out: Any) -> Any:
        x = dataclasses.replace(x, t_ns=x.t_ns + i * 492_000_000)
        return dataclasses.replace(state, mode=mode), x, with_decision(out, d_measured=distance[i])

    return edited(recording, len(distance), edit)


def test_every_near_miss_is_found_at_its_least_distance(recording: Any, tmp_path: Path) -> None:
    distance = [0.5, 0.19, 0.15, 0.18, 0.5, 0.5, 0.5, 0.5, 0.12, 0.08, 0.5, np.inf]
    log = open_recording(recording.write(recording.packed(dated(recording, distance))))
    found = nearest_moments(log)
    start_ns = int(log.columns("inputs.t_ns")["inputs.t_ns"][0])
    assert found.distance.tolist() == [0.15, 0.08]
    assert ((found.t_ns - start_ns) * 1e-9).tolist() == pytest.approx([1.0, 4.5])
    assert found.worst_ns == found.t_ns[1]
    canvas = Canvas(new_recording("x"), log.params, start_ns)
    levels = [(e.level, e.text) for e in draw_near_misses(canvas, found)]
    assert [level for level, _ in levels] == ["WARN", "ERROR"]
    assert "0.080 m" in levels[1][1]


def test_a_robot_that_holds_has_no_near_miss(recording: Any) -> None:
    log = open_recording(recording.write(recording.packed(dated(recording, [0.5, 0.1, 0.5], Mode.HOLD))))
    assert len(nearest_moments(log).t_ns) == 0


def test_changes_are_told_once_with_their_reason(recording: Any) -> None:
    def edit(i: int, state: Any, x: Any, out: Any) -> Any:
        mode, reason = (Mode.STOPPING, StopReason.HUMAN_STALE) if i >= 5 else (Mode.ACTIVE, StopReason.NONE)
        state = dataclasses.replace(state, mode=mode, reason=reason, reached_id=i // 7)
        status = Status.INFEASIBLE if i in (2, 3) else Status.PASS
        return state, dataclasses.replace(x, missed_ticks=3 * (i == 6)), with_decision(out, status=status)

    block = records(recording.write(recording.packed(edited(recording, 10, edit))))
    t = block["inputs.t_ns"].tolist()
    assert sorted(changes(block[:-1], block[1:])) == [
        Event(t[2], "ERROR", "no control keeps every row"),
        Event(t[2], "INFO", "operator: ARM"),
        Event(t[4], "WARN", "STOPPING: HUMAN_STALE"),
        Event(t[6], "INFO", "goal 1 reached"),
        Event(t[6], "WARN", "3 samples of the robot lost"),
    ]


def test_modes_are_drawn_where_they_change(recording: Any, tmp_path: Path) -> None:
    found = content(rrd_of(recording, tmp_path, recording.cycles(1100)))
    assert [row[0] for row in found["state/mode"]["state"]] == ["HOLD", "ACTIVE"]
    assert found["state/mode"]["t"] == pytest.approx([0.0, 2 * PERIOD_S])


# --- long sessions ---------------------------------------------------------------------------------------------------


def test_blocks_overlap_by_one_cycle_and_lose_none() -> None:
    numbers = np.arange(103)
    blocks = list(in_blocks(np.split(numbers, [1, 7, 7, 30, 31, 90]), rows=10))  # type: ignore[arg-type]
    assert np.concatenate([block[:-1] for block in blocks]).tolist() == numbers[:-1].tolist()
    assert np.concatenate([block[1:] for block in blocks]).tolist() == numbers[1:].tolist()


def test_camera_images_are_shown_beside_the_scene(recording: Any, tmp_path: Path) -> None:
    depth = cv2.imencode(".png", np.full((4, 6), 1500, np.uint16))[1].tobytes()
    colour = cv2.imencode(".jpg", np.zeros((4, 6, 3), np.uint8))[1].tobytes()
    out = new_recording("x")
    out.save(tmp_path / "x.rrd")
    canvas = Canvas(out, recording.params, 0)
    canvas.image("camera/left", 2_000_000_000, "png", depth)
    canvas.image("camera/right", 3_000_000_000, "jpeg", colour)
    out.disconnect()
    found = content(tmp_path / "x.rrd")
    assert found["camera/left"]["t"] == [2.0]
    assert found["camera/left"]["meter"] == [[1000.0]]  # depth
    assert "blob" in found["camera/right"] and "meter" not in found["camera/right"]
    assert layout(recording.params, (0.0, 1.0), cameras=("camera/left",)) is not None


def test_a_thinned_scene_keeps_the_nearest_cycle(recording: Any, tmp_path: Path) -> None:
    distance = np.linspace(2.0, 1.0, 41)
    distance[[6, 23]] = 0.1, 0.2
    block = records(recording.write(recording.packed(dated(recording, distance.tolist()))))
    out = new_recording("x")
    out.save(tmp_path / "x.rrd")
    Canvas(out, recording.params, 0, scene_stride=10).draw(block[:-1], block[1:])
    out.disconnect()
    found = content(tmp_path / "x.rrd")
    assert (np.array(found["cell/nearest"]["t"]) * 1e9).round(-3).tolist() == pytest.approx(
        block["inputs.t_ns"][[6, 19, 23, 39]]
    )
    assert len(found["plot/distance"]["t"]) == 40


# --- bad input -------------------------------------------------------------------------------------------------------


def test_a_log_without_cycles_is_one_clear_line(recording: Any, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="nothing to show") as told:
        view(recording.write([]), save=tmp_path / "x.rrd")
    assert "\n" not in str(told.value)
    assert not (tmp_path / "x.rrd").exists()


@pytest.mark.parametrize("at", [-0.1, 99.0, float("nan")])
def test_a_moment_outside_the_session_is_refused(recording: Any, tmp_path: Path, at: float) -> None:
    path = recording.write(recording.packed(recording.cycles(10)))
    with pytest.raises(ViewError, match="from 0 to 0.072 s"):
        view(path, shot=tmp_path / "x.png", at=at)


def test_a_moment_without_a_picture_is_refused(recording: Any) -> None:
    with pytest.raises(ViewError, match="--shot"):
        view(recording.write(recording.packed(recording.cycles(10))), at=0.01)


def test_a_picture_draws_its_surroundings_on_the_clock_of_the_session(recording: Any, tmp_path: Path) -> None:
    log = open_recording(recording.write(recording.packed(recording.cycles(60))))
    moment_ns = int(log.columns("inputs.t_ns")["inputs.t_ns"][40])
    write_rrd(log, tmp_path / "x.rrd", moment_ns, log.around(moment_ns, 40_000_000))
    found = content(tmp_path / "x.rrd")
    times = found["plot/distance"]["t"]
    assert times[0] <= 0.28 and times[0] > 0.2 and 0.352 <= times[-1] < 0.45  # 0.32 s and 0.04 s around it
    assert found["events"]["t"][-1] == pytest.approx(59 * 0.008)  # how the session ended belongs to every picture


def test_a_window_needs_a_display(recording: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ViewError, match="--shot"):
        view(recording.write(recording.packed(recording.cycles(10))))


# --- live ------------------------------------------------------------------------------------------------------------


def test_live_draws_the_same_as_the_recording(recording: Any, tmp_path: Path) -> None:
    cycles = recording.cycles(50)
    packed = recording.packed(cycles)
    out = new_recording("x")
    out.save(tmp_path / "live.rrd")
    painter = Painter(out, recording.params, recording.layout.dtype)
    for a, b in ((0, 0), (0, 1), (1, 20), (20, 23), (23, 50)):
        painter.paint(packed[a:b])
    out.disconnect()
    live, whole = content(tmp_path / "live.rrd"), content(rrd_of(recording, tmp_path, cycles))
    for entity in ("plot/distance", "plot/u/J2", "plot/age"):
        assert np.array_equal(scalars(live[entity]), scalars(whole[entity]), equal_nan=True)
        assert live[entity]["t"] == pytest.approx(whole[entity]["t"])
    assert [row[0] for row in live["state/mode"]["state"]] == ["HOLD", "ACTIVE"]
