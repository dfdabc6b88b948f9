from asc_rt.core.types import StopReason
from asc_rt.stop_hints import HINTS


def test_every_stop_tells_what_to_do() -> None:
    assert HINTS.keys() == set(StopReason) - {StopReason.NONE}
    assert all(HINTS.values())
