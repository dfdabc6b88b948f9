"""Bus load against the figures that the standard's frame layouts give, in microseconds and shares."""

from __future__ import annotations

import pytest

from drivers.can.bus_load import BusOverload, FrameSize, check, load

CLASSIC, FD = FrameSize(8), FrameSize(8, is_fd=True, switches_rate=True)


@pytest.mark.parametrize(("length", "bits"), [(0, 55), (1, 65), (4, 95), (6, 115), (8, 135)])
def test_classic_frames_in_the_worst_case(length: int, bits: int) -> None:
    assert FrameSize(length).seconds(1e6, 0.0) == pytest.approx(bits * 1e-6)


def test_extended_identifiers_take_longer() -> None:
    assert FrameSize(8, is_extended=True).seconds(1e6, 0.0) == pytest.approx(160e-6)


@pytest.mark.parametrize(
    ("frame", "data_bitrate", "us"),
    [
        (FD, 5e6, 56.6),
        (FD, 8e6, 48.125),
        (FrameSize(64, is_fd=True, switches_rate=True), 5e6, 169.6),
        (FrameSize(64, is_fd=True, switches_rate=True), 8e6, 118.75),
        (FrameSize(8, is_fd=True), 5e6, 147.0),
    ],
)
def test_fd_frames_in_the_worst_case(frame: FrameSize, data_bitrate: float, us: float) -> None:
    assert frame.seconds(1e6, data_bitrate) == pytest.approx(us * 1e-6)


def test_seven_classic_axes_at_500_hz_are_refused_with_the_figure() -> None:
    with pytest.raises(BusOverload, match=r"2 ms takes 94% of the bus.*at most 80%") as caught:
        check([CLASSIC] * 14, 0.002, 1e6)
    assert caught.value.load == pytest.approx(0.945)


def test_what_fits_is_taken() -> None:
    assert check([CLASSIC] * 14, 0.004, 1e6) == pytest.approx(0.4725)
    assert check([FD] * 14, 0.001, 1e6, 5e6) == pytest.approx(0.7924)
    assert check([FrameSize(0), *[CLASSIC] * 14], 0.004, 1e6) == pytest.approx(0.48625)  # CANopen with SYNC
    with pytest.raises(BusOverload):
        check([FD] * 16, 0.001, 1e6, 5e6)
    assert load([FrameSize(8, is_fd=True), FD] * 7, 0.002, 1e6, 5e6) == pytest.approx(0.7126)  # command without BRS


def test_lengths_are_told_with_the_kind_of_frame() -> None:
    with pytest.raises(ValueError, match="no CAN FD frame has 10 data bytes"):
        FrameSize(10, is_fd=True)
    with pytest.raises(ValueError, match="no CAN frame has 10 data bytes"):
        FrameSize(10)
    with pytest.raises(ValueError, match="29-bit identifiers are not in the formulas"):
        FrameSize(8, is_fd=True, is_extended=True)


@pytest.mark.parametrize(
    "wrong", [{"length": 9}, {"length": -1}, {"length": 10, "is_fd": True}, {"length": 8, "switches_rate": True}]
)
def test_frames_that_no_bus_carries(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="frame"):
        FrameSize(**wrong)  # type: ignore[arg-type]
