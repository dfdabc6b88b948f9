from __future__ import annotations

import sys
from importlib.metadata import EntryPoint

import pytest

from drivers import registry
from drivers.loopback import Loopback


def test_a_name_gives_its_class() -> None:
    assert registry.driver_class("loopback") is Loopback


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(
        ValueError, match=r"unknown driver 'fanuc'; known: can, fanuc-j519, fanuc-stream-motion-b, loopback"
    ):
        registry.driver_class("fanuc")


def test_only_the_driver_that_is_asked_for_is_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "drivers.loopback", raising=False)
    registry.known()
    assert "drivers.loopback" not in sys.modules
    registry.driver_class("loopback")
    assert "drivers.loopback" in sys.modules


def test_installed_packages_add_drivers_but_take_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        EntryPoint("mine", "drivers.loopback:Loopback", registry.GROUP),
        EntryPoint("loopback", "os:path", registry.GROUP),
        EntryPoint("broken", "no_such_module:Thing", registry.GROUP),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: points if group == "asc.drivers" else [])
    assert registry.driver_class("mine").__name__ == "Loopback"
    assert registry.driver_class("loopback").__name__ == "Loopback"
    with pytest.raises(ValueError, match="driver 'broken'.*cannot be loaded.*no_such_module"):
        registry.driver_class("broken")
