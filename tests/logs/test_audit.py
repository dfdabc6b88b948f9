"""Every rule of the audit holds for a good session and breaks when what it is about is broken."""

import dataclasses
import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from asc_rt.core.types import CommandKind, JointCommand, Mode, StopReason, vector
from drivers.registry import driver_class
from logs import audit_rules as rules
from logs import audit_wire, schema, seal
from logs.audit import audit, chosen, with_hash
from logs.audit_evidence import Evidence, gather
from logs.commands import verdict
from logs.mcap_scan import LogError
from logs.recording import open_recording
from logs.recover import recover
from logs.replay import FirstDifference, replay
from logs.report import Picture, html_report, moments

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


@pytest.fixture
def session(core_session: tuple[Path, list[Any]]) -> Path:
    return core_session[0]


@pytest.fixture
def evidence(session: Path) -> Evidence:
    return gather(session)


def test_a_good_session_keeps_every_rule(session: Path) -> None:
    report, _ = audit(session, KEY.public_key(), "KEY", sample=40)
    assert [rule["name"] for rule in report["rules"] if not rule["holds"]] == []
    assert report["holds"]
    assert set(report["not_judged"]) == {"joint torque", "sent bytes", "tool"}
    keys = {"rules", "sealed", "crc_ok", "complete", "cycles", "gaps", "min_distance_m", "worst_phi", "stops"}
    assert keys | {"certificate"} <= set(report)
    assert (report["cycles"], report["crc_ok"], report["complete"], report["gaps"]) == (150, True, True, [])
    assert report["sealed"]["ok"] and report["sealed"]["final"]
    assert 0 < report["min_distance_m"] < 0.9
    assert report["worst_phi"] is not None
    assert verdict(report)[-1].startswith("every rule holds")


def test_the_report_is_the_same_each_time_and_its_hash_is_over_all_of_it(session: Path) -> None:
    first, again = audit(session, sample=5)[0], audit(session, sample=5)[0]
    assert first == again
    changed = {key: value for key, value in first.items() if key != "report_sha256"}
    assert with_hash(changed) == first
    assert with_hash({**changed, "cycles": 1})["report_sha256"] != first["report_sha256"]
    json.dumps(first, allow_nan=False)


# --- each rule, broken -----------------------------------------------------------------------------------------------


def active(e: Evidence) -> int:
    """A cycle in the middle of the motion."""
    return int(np.flatnonzero(e.mode == Mode.ACTIVE)[80])


def still_other(e: Evidence) -> None:
    e.log.parts[0].attachments["cell.toml"] = b"other"


def gone(e: Evidence) -> None:
    del e.log.parts[0].attachments["cell.toml"]


def no_key(e: Evidence) -> None:
    e.log.parts[0].seals.public_key = ""


def no_seal(e: Evidence) -> None:
    e.log.parts[0].seals.count = 0


def other_key(e: Evidence) -> None:
    e.trusted, e.trusted_name = Ed25519PrivateKey.from_private_bytes(bytes(32)).public_key(), "OTHER"


def other_file(e: Evidence) -> None:
    e.log.path.write_bytes(e.log.path.read_bytes() + b"x")


def not_closed(e: Evidence) -> None:
    e.log.parts[0].extent.closed = False


def altered(e: Evidence) -> None:
    e.broken_records = 1


def gap(e: Evidence) -> None:
    e.c["inputs.tick"][50:] += 3


def twice(e: Evidence) -> None:
    e.c["inputs.tick"][50:] -= 1


def pause(e: Evidence) -> None:
    e.c["inputs.t_ns"][active(e) :] += 40_000_000


def backwards(e: Evidence) -> None:
    e.c["inputs.t_ns"][active(e) :] -= 9_000_000


def old_person(e: Evidence) -> None:
    e.c["inputs.sensors.age_ns"][active(e), 0] = e.log.params.human.age_limit_ns + 1


def future_person(e: Evidence) -> None:
    e.c["inputs.sensors.age_ns"][active(e), 0] = -e.log.params.human.future_limit_ns - 1


def no_person(e: Evidence) -> None:
    e.c["inputs.human.present"][active(e)] = 0


def sick_person(e: Evidence) -> None:
    e.c["inputs.sensors.health"][active(e), 0] = 2


def refused_message(e: Evidence) -> None:
    e.c["inputs.sensors.fault"][active(e), 0] = 2


def covered_camera(e: Evidence) -> None:
    e.c["inputs.sensors.coverage"][active(e), 0] = 0.1


def other_camera(e: Evidence) -> None:
    e.c["inputs.sensors.id"][active(e), 0] = 2


def beyond(path: str, limit: str, joint: int = 2, factor: float = 1.01) -> Callable[[Evidence], None]:
    def spoil(e: Evidence) -> None:
        e.c[path][active(e), joint] = -factor * getattr(e.log.params.robot, limit)[joint]

    return spoil


def too_far(e: Evidence) -> None:
    e.c["inputs.joint.q"][active(e), 1] = e.log.params.robot.q_max[1] + 0.01


def not_a_number(e: Evidence) -> None:
    e.c["state.dq_cmd"][active(e), 0] = np.nan


def jump(e: Evidence) -> None:
    e.c["state.ddq_cmd"][active(e), 3] += 1.1 * e.log.params.robot.dddq_max[3] * e.log.params.period


def near(e: Evidence) -> None:
    """The arm that went away from the person goes towards it instead."""
    cycles = np.flatnonzero(e.mode == Mode.ACTIVE)
    away = int(cycles[rules.approach(e, cycles).argmin()])
    e.c["outputs.decision.d_measured"][away] = e.log.params.safety.d_min - 0.001
    record = bytearray(e.log.record(away))
    offset = e.log.layout.dtype.fields["inputs.joint.dq"][1]  # type: ignore[index]
    record[offset : offset + 48] = (-np.frombuffer(record, float, 6, offset)).tobytes()
    e.log.record = lambda index: bytes(record)  # type: ignore[method-assign]


def test_a_person_who_comes_nearer_is_not_the_arms_doing(evidence: Evidence) -> None:
    cycles = np.flatnonzero(evidence.mode == Mode.ACTIVE)
    away = cycles[rules.approach(evidence, cycles) < 0.0]
    evidence.c["outputs.decision.d_measured"][away[0]] = evidence.log.params.safety.d_min - 0.001
    found = rules.separation(evidence)
    assert found.holds
    assert "in 1 cycles" in found.detail


def broken_row(e: Evidence) -> None:
    e.c["least_slack"][active(e)] = -0.01


def endless_stop(e: Evidence) -> None:
    e.c["state.mode"][20:] = Mode.STOPPING
    e.c["state.reason"][20:] = StopReason.HUMAN_STALE


def sent_late(e: Evidence) -> None:
    e.c["receipt.t_tx_ns"][active(e)] += 300_000_000


def stop_without_cause(e: Evidence) -> None:
    i = active(e)
    e.c["state.mode"][i : i + 2] = Mode.STOPPING
    e.c["state.mode"][i + 2 :] = Mode.STOPPED


def creeps(e: Evidence) -> None:
    e.c["state.mode"][:] = Mode.HOLD


def armed_by_nobody(e: Evidence) -> None:
    e.c["inputs.events.count"][:] = 0


def decided_otherwise(e: Evidence) -> None:
    report = replay(e.log.path, cycles=[5])
    first = FirstDifference(5, "outputs.decision.u_safe[0]", 1.0, 2.0)
    e.replay = dataclasses.replace(report, mismatches=1, first_difference=first)


def other_packets(e: Evidence) -> None:
    e.replay = dataclasses.replace(replay(e.log.path, cycles=[5]), wire_mismatches=1, wire_first="cycle 3: other")


@pytest.mark.parametrize(
    ("rule", "spoil"),
    [
        (rules.identity, still_other), (rules.identity, gone),
        (rules.seals, no_key), (rules.seals, no_seal), (rules.seals, other_key),
        (rules.signature, other_file), (rules.closed, not_closed), (rules.records, altered),
        (rules.completeness, gap), (rules.completeness, twice), (rules.timing, pause), (rules.timing, backwards),
        (rules.human_age, old_person), (rules.human_age, future_person), (rules.human_age, no_person),
        (rules.human_age, sick_person), (rules.human_age, refused_message), (rules.human_age, covered_camera),
        (rules.human_age, other_camera), (rules.position, too_far), (rules.speed, beyond("state.dq_cmd", "dq_max")),
        (rules.speed, not_a_number), (rules.acceleration, beyond("state.ddq_cmd", "ddq_max")), (rules.jerk, jump),
        (rules.separation, near), (rules.safety_rows, broken_row), (rules.stop_times, endless_stop),
        (rules.reaction, sent_late),
        (rules.stop_times, stop_without_cause), (rules.no_motion, creeps), (rules.armed, armed_by_nobody),
        (rules.replayed, decided_otherwise), (rules.wire, other_packets),
    ],
    ids=lambda x: getattr(x, "__name__", ""),
)  # fmt: skip
def test_what_is_wrong_breaks_its_rule(evidence: Evidence, rule: rules.Rule, spoil: Callable[[Any], None]) -> None:
    before = rule(evidence)
    assert before.holds, before.detail
    spoil(evidence)
    after = rule(evidence)
    assert not after.holds
    assert after.name == before.name
    assert "\n" not in after.detail


def test_what_was_attached_later_is_named(evidence: Evidence) -> None:
    evidence.log.parts[0].attachments["later.json"] = b"{}"
    found = rules.identity(evidence)
    assert found.holds
    assert found.detail.endswith("later later.json")


def test_a_pause_that_was_declared_is_no_fault(evidence: Evidence) -> None:
    pause(evidence)
    evidence.c["inputs.late"][active(evidence)] = 1
    assert rules.timing(evidence).holds


def test_torques_are_judged_where_they_are_sent(evidence: Evidence) -> None:
    robot = dataclasses.replace(evidence.log.params.robot, effort=(10.0,) * 6)
    evidence.log.params = dataclasses.replace(evidence.log.params, robot=robot)
    evidence.c["outputs.command.kind"][:] = CommandKind.TORQUE
    evidence.c["outputs.command.tau"][:] = 9.0
    assert rules.torque(evidence).worst == 9.0
    evidence.c["outputs.command.tau"][70, 2] = -11.0
    assert not rules.torque(evidence).holds


def test_the_worst_moment_is_named(evidence: Evidence) -> None:
    beyond("state.dq_cmd", "dq_max", joint=4, factor=2.0)(evidence)
    found = rules.speed(evidence)
    assert f"J5 at cycle {active(evidence)}" in found.detail
    assert found.limit == evidence.log.params.robot.dq_max[4]
    assert found.worst == pytest.approx(2 * found.limit)


@pytest.mark.parametrize("byte", [None, 11, 40, -1])
def test_sent_bytes_are_decoded_independently(wire_session: Callable[..., Path], byte: int | None) -> None:
    """The sequence, a joint, the last byte: flipped, each is noticed."""

    def spoil(packets: Any) -> None:
        if byte is not None:
            channel, t_ns, data = packets[7]
            changed = bytearray(data)
            changed[byte if byte > 0 else 33] ^= 0x40
            packets[7] = (channel, t_ns, bytes(changed))

    found = rules.wire_bytes(gather(wire_session(spoil)))
    assert found.holds == (byte is None)
    assert not found.skipped


@pytest.mark.parametrize(
    ("driver", "options", "flip"),
    [
        ("fanuc-j519", {"version": 3}, 18),
        ("fanuc-stream-motion-b", {}, 13),
        ("fanuc-stream-motion-b", {}, 14),
        ("fanuc-stream-motion-b", {}, 0),
    ],
)
def test_each_decoder_agrees_with_the_codec_it_shares_nothing_with(
    driver: str, options: dict[str, Any], flip: int
) -> None:
    codec: Any = driver_class(driver)({"host": "127.0.0.1", **options})
    q = vector(np.linspace(-1.2, 1.3, 6))
    data = codec.encode_command(4711, JointCommand(0, CommandKind.POSITION, q, q, q, True))
    told = audit_wire.DECODERS[driver](data)
    assert told is not None and (told.seq, told.last) == (4711, True)
    np.testing.assert_allclose(told.q, q, atol=audit_wire.ROUNDING)
    broken = bytearray(data)
    broken[flip] ^= 0x41
    assert audit_wire.DECODERS[driver](bytes(broken)) is None
    assert audit_wire.DECODERS[driver](data[:-1]) is None
    assert audit_wire.DECODERS[driver](b"") is None


# --- whole files -----------------------------------------------------------------------------------------------------


def test_an_altered_file_is_a_report_and_no_traceback(session: Path) -> None:
    data = bytearray(session.read_bytes())
    data[len(data) // 2] ^= 1
    session.write_bytes(data)
    report, evidence = audit(session)
    assert evidence is None
    assert (report["holds"], report["crc_ok"], report["sealed"]["ok"]) == (False, False, False)
    assert "damaged" in report["rules"][0]["detail"]
    assert "NOT IN ORDER" in html_report(report, None)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"x")
    with pytest.raises(LogError):
        audit(tmp_path / "x.mcap")


def test_a_recovered_file_passes_and_says_so(session: Path, tmp_path: Path) -> None:
    whole = open_recording(session)
    place = whole.parts[0]._chunks[-2].raw.end + 30  # in the index behind it
    session.write_bytes(session.read_bytes()[:place])
    broken = audit(session, sample=5)[0]
    assert [rule["name"] for rule in broken["rules"] if not rule["holds"]] == ["signature", "closed"]
    found = recover(session, tmp_path / "whole.mcap", key=KEY)
    assert found.bytes_cut > 0
    report = audit(tmp_path / "whole.mcap", KEY.public_key(), "KEY", sample=5)[0]
    assert report["holds"], verdict(report)
    (closed,) = (rule for rule in report["rules"] if rule["name"] == "closed")
    assert closed["detail"] == f"recovered, {found.bytes_cut} bytes cut"


@pytest.mark.parametrize("simulated", [True, False])
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda e: e.log.attachments.pop(schema.CERTIFICATE), "none for tool drill on lrmate_200id"),
        (lambda e: e.log.attachments.update({schema.CERTIFICATE: b"{}"}), "not a certificate of format"),
        (
            lambda e: setattr(e.log, "params", dataclasses.replace(e.log.params, control="torque")),
            "for acceleration control",
        ),
    ],
)
def test_without_a_certificate_only_a_simulated_session_is_in_order(
    evidence: Evidence, spoil: Callable[[Evidence], None], said: str, simulated: bool
) -> None:
    before = rules.certificate(evidence)
    assert before.holds and not before.skipped and "covers tool drill on lrmate_200id" in before.detail
    evidence.log.session["simulated"] = str(simulated).lower()
    spoil(evidence)
    found = rules.certificate(evidence)
    assert said in found.detail
    assert (found.holds, found.skipped) == ((False, False) if "format" in said else (simulated, simulated))


def test_the_cycles_around_every_change_are_always_run_again(evidence: Evidence) -> None:
    picked = chosen(evidence, 5)
    armed = int(np.flatnonzero(evidence.mode_after != evidence.mode)[-1])
    assert {armed - 1, armed, armed + 1} <= set(picked)
    assert {0, 149} <= set(picked)
    assert len(picked) < 25
    assert chosen(evidence, None) == range(150)


# --- the page --------------------------------------------------------------------------------------------------------


def test_the_page_needs_nothing_else_and_shows_the_near_miss_first(session: Path) -> None:
    report, evidence = audit(session, sample=5)
    assert evidence is not None
    wanted = moments(evidence)
    assert wanted[0].text.startswith("nearest approach")
    page = html_report(report, evidence, [Picture(wanted[0], b"\x89PNG")])
    assert page.index("nearest approach") < page.index("<h2>Rules")
    assert report["report_sha256"] in page
    assert "data:image/png;base64," in page
    assert "http" not in page.replace("http://www.w3.org", "")
    plots = [part.split("</svg>")[0] for part in page.split("<svg")[1:]]
    assert len(plots) == 7  # the last is of the latencies
    for plot in plots:
        ET.fromstring(f"<svg{plot}</svg>")
        assert "nan" not in plot and "inf" not in plot.replace("info", "")


def test_a_broken_rule_stands_in_the_head_of_the_page(session: Path) -> None:
    report, evidence = audit(session, Ed25519PrivateKey.from_private_bytes(bytes(32)).public_key(), "<OTHER>", sample=5)
    page = html_report(report, evidence)
    assert "NOT IN ORDER: seals" in page
    assert "<OTHER>" not in page  # what a file says is text, never markup
    assert "&lt;OTHER&gt;" in page


def test_keys_of_the_seals_are_told(session: Path) -> None:
    report = audit(session, sample=5)[0]
    assert report["sealed"]["key"] == seal.raw_hex(KEY.public_key())
    assert schema.CELL in report["attachments"]
