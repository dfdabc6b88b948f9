"""The file, and the table of everything that makes a certificate not cover a cell."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from asc_rt.config import load_arm, load_cell
from asc_rt.core.params import Params
from asc_rt.synthesis import certificate as c
from asc_rt.synthesis.certify import certify as make
from asc_rt.synthesis.certify import recheck, request_of

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def params() -> Params:
    return load_cell("fanuc-sim-truth").params


@pytest.fixture(scope="module")
def made(params: Params, bench: Any) -> c.Certificate:
    s = params.safety
    ranges = replace(
        bench.RANGES, d_low=s.d_min, d_high=s.activation_distance, speed_share=params.task.speed, v_max=2.0,
        human_acceleration=s.human_acceleration,
    )  # fmt: skip
    return make(request_of(params, ranges, samples=3000, required=0.5)).certificate


def test_a_certificate_covers_the_cell_it_was_made_for(made: c.Certificate, params: Params) -> None:
    assert made.certified
    assert made.reasons == ()
    assert c.covers(made, params) == []
    careful = replace(params.safety, k=5.0, activation_distance=0.8, human_acceleration=0.0, eta=0.5, M_floor=1.0)
    assert c.covers(made, replace(params, safety=careful, task=replace(params.task, speed=0.1))) == []
    r = params.robot
    strong = replace(r, ddq_max=tuple(2.0 * v for v in r.ddq_max), dq_max=tuple(0.5 * v for v in r.dq_max))
    assert c.covers(made, replace(params, robot=strong)) == []


def safety(**changes: float) -> Callable[[Params], Params]:
    return lambda p: replace(p, safety=replace(p.safety, **changes))


REFUSED: dict[str, tuple[Callable[[Params], Params], str]] = {
    "another robot": (
        lambda p: replace(p, robot=replace(p.robot, name="ur5e")),
        "for robot lrmate_200id, not for ur5e",
    ),
    "robot changed": (
        lambda p: replace(p, robot=replace(p.robot, urdf=p.robot.urdf + " ")),
        "data of robot lrmate_200id",
    ),
    "less acceleration": (
        lambda p: replace(p, robot=replace(p.robot, ddq_max=tuple(0.9 * v for v in p.robot.ddq_max))),
        "ddq_max of J1 is 7.854 rad/s2, under the certified 8.727",
    ),
    "less jerk": (
        lambda p: replace(p, robot=replace(p.robot, dddq_max=(*p.robot.dddq_max[:5], 1.0))),
        "dddq_max of J6 is 1 rad/s3, under the certified 69.81",
    ),
    "more speed": (
        lambda p: replace(p, robot=replace(p.robot, dq_max=(9.0, *p.robot.dq_max[1:]))),
        "dq_max of J1 is 9 rad/s, above the certified 7.854",
    ),
    "another tool": (lambda p: replace(p, tool=replace(p.tool, name="bat")), "for tool drill, not for bat"),
    "tool changed": (lambda p: replace(p, tool=replace(p.tool, mass=1.7)), "data of tool drill have changed"),
    "control": (lambda p: replace(p, control="torque"), "for acceleration control, the cell has torque"),
    "k too small": (safety(k=2.9), "safety.k = 2.9 is under the certified 3"),
    "d_min smaller": (safety(d_min=0.05), "safety.d_min_m = 0.05, certified for 0.1"),
    "d_min larger": (safety(d_min=0.2), "safety.d_min_m = 0.2, certified for 0.1"),
    "activation": (safety(activation_distance=1.5), "safety.activation_m = 1.5 is beyond"),
    "faster approach": (safety(v_max=3.0), "safety.v_max_m_s = 3 is above the certified 2"),
    "floor": (safety(M_floor=0.1), "safety.M_floor = 0.1 is under the certified 0.3"),
    "eta": (safety(eta=2.0), "safety.eta = 2 is above the certified 1"),
    "person": (safety(human_acceleration=30.0), "human_acceleration_m_s2 = 30 is above the certified"),
    "speed": (lambda p: replace(p, task=replace(p.task, speed=0.9)), "task.speed = 0.9 is above the certified 0.5"),
    "period": (lambda p: replace(p, period_ns=16_000_000), "a period of 16 ms is above the certified 8 ms"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_every_way_not_to_be_covered_is_told(made: c.Certificate, params: Params, case: str) -> None:
    change, said = REFUSED[case]
    reasons = c.covers(made, change(params))
    assert len(reasons) == 1
    assert said in reasons[0]


def test_certificates_that_cannot_cover_any_cell(made: c.Certificate, params: Params) -> None:
    for change, said in (
        ({"certified": False, "reasons": ("3 of 9 states",)}, "it does not certify: 3 of 9 states"),
        ({"method": c.METHOD - 1}, "it is stale: made by method"),
        ({"format": c.FORMAT + 1}, "it is stale: made by method"),
        ({"index": c.Index.PHI_B}, "for index phi-b"),
        ({"ranges": replace(made.ranges, joint_limits=False)}, "leaves the joint limits out"),
    ):
        assert any(said in reason for reason in c.covers(replace(made, **change), params))  # type: ignore[arg-type]


def test_all_reasons_are_told_at_once(made: c.Certificate, params: Params) -> None:
    wrong = safety(k=1.0, d_min=0.3, eta=9.0)(params)
    assert len(c.covers(made, wrong)) == 3


def test_the_file_gives_the_same_certificate(made: c.Certificate, tmp_path: Path) -> None:
    file = tmp_path / "made.json"
    file.write_text(c.to_json(made))
    assert c.load(file) == made


def test_missing_covering_and_broken_files(made: c.Certificate, params: Params, tmp_path: Path) -> None:
    (reason,) = c.refusals(params, tmp_path)
    assert "missing" in reason
    assert "asc certify --cell CELL --tool drill" in reason
    file = tmp_path / c.file_name("lrmate_200id", "drill")
    file.write_text(c.to_json(made))
    assert c.refusals(params, tmp_path) == []
    (reason,) = c.refusals(safety(k=1.0)(params), tmp_path)
    assert reason.startswith(f"{file}: safety.k = 1")
    file.write_text(c.to_json(made)[:-40])
    (reason,) = c.refusals(params, tmp_path)
    assert "not JSON" in reason


@pytest.mark.parametrize(
    ("key", "value"),
    [("k", "3"), ("ranges", {}), ("certified", 1), ("index", "phi-x"), ("worst", [{}]), ("robot", None), ("extra", 1)],
)
def test_a_file_of_another_shape_is_refused_in_one_line(
    made: c.Certificate, tmp_path: Path, key: str, value: object
) -> None:
    tree = json.loads(c.to_json(made))
    tree[key] = value
    file = tmp_path / "odd.json"
    file.write_text(json.dumps(tree))
    with pytest.raises(c.CertificateError, match="not a certificate of format") as caught:
        c.load(file)
    assert "\n" not in str(caught.value)


def test_lists_and_scalars_are_no_certificates(tmp_path: Path) -> None:
    for text in ("[]", "1", "null", '"x"', "{}"):
        (tmp_path / "x.json").write_text(text)
        with pytest.raises(c.CertificateError):
            c.load(tmp_path / "x.json")


def test_the_worst_states_are_what_the_cell_computes(made: c.Certificate) -> None:
    assert {w.why for w in made.worst} >= {"least M", "greatest M", "fastest fall of M", "least margin on phi = 0"}
    assert recheck(made, *load_arm("lrmate_200id", "drill")) == []
    off = replace(made, worst=(replace(made.worst[0], M=made.worst[0].M + 0.01), *made.worst[1:]))
    (reason,) = recheck(off, *load_arm("lrmate_200id", "drill"))
    assert "stale: least M" in reason
    reasons = recheck(made, *load_arm("lrmate_200id", "bat"))
    assert len(reasons) == len(made.worst)
    assert "the arm has no capsule drill" in reasons[0]
