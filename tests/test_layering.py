"""The layers of the house. Each rule is read off the imports, wherever in a file they stand."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PRODUCT = ("asc_rt", "drivers", "calibration", "logs")
PACKAGES = (*PRODUCT, "sim_hil")


def sources(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imports(path: Path) -> Iterator[str]:
    """Every module that the file imports, by its full name; `from a import b` gives a and a.b."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)}: imports are absolute"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def users(module: str, *folders: str) -> set[str]:
    """The files that import `module` or something inside it."""
    return {
        name_of(path)
        for path in sources(*folders)
        if any(found == module or found.startswith(f"{module}.") for found in imports(path))
    }


# --- 1. the core is pure ---------------------------------------------------------------------------------------------

CORE_MAY = {"numpy", "pinocchio", "piqp", "ruckig", "numba", "asc_rt"}
CORE_MAY_STDLIB = {
    "__future__", "bisect", "collections", "dataclasses", "enum", "functools", "hashlib", "itertools", "json", "math",
    "operator", "typing",
}  # fmt: skip


@pytest.mark.parametrize("path", sources("asc_rt/core"), ids=name_of)
def test_the_core_imports_mathematics_and_itself(path: Path) -> None:
    for found in imports(path):
        assert found.partition(".")[0] in CORE_MAY | CORE_MAY_STDLIB, found
        if found.startswith("asc_rt"):
            assert found == "asc_rt" or found.startswith("asc_rt.core"), found


@pytest.mark.parametrize("path", [*sources("asc_rt/core"), ROOT / "asc_rt" / "cycle.py"], ids=name_of)
def test_core_and_loop_ask_neither_the_environment_nor_whether_it_is_real(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute):
            assert node.attr not in ("environ", "getenv", "argv", "simulated", "is_replay")
        if isinstance(node, ast.If | ast.IfExp | ast.While):
            names = {n.id for n in ast.walk(node.test) if isinstance(n, ast.Name)}
            assert not names & {"sim", "replay", "simulated", "is_sim"}


def test_degrees_stay_out_of_the_core() -> None:
    for path in sources("asc_rt/core"):
        words = {n.attr for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Attribute)}
        assert not words & {"radians", "degrees", "deg2rad", "rad2deg"}, name_of(path)


# The same for every backend; and how each of them plays a file.
CAMERA_CONTRACT = ("drivers.cameras.base", "drivers.cameras.watch", "drivers.cameras.replay")

# --- 2. drivers ------------------------------------------------------------------------------------------------------


def test_the_runtime_knows_drivers_by_their_interface_only() -> None:
    for path in sources("asc_rt", "logs", "calibration"):
        for found in imports(path):
            if found.startswith("drivers."):
                contract = found.split(".")[1] in ("base", "registry") or found.startswith(CAMERA_CONTRACT)
                assert contract, f"{name_of(path)} imports {found}"


def test_a_driver_imports_no_other_driver() -> None:
    shared = {"base", "owner", "registry"}
    for path in sources("drivers"):
        own = path.relative_to(ROOT / "drivers").parts[0].removesuffix(".py")
        for found in imports(path):
            if found.startswith("drivers."):
                assert found.split(".")[1] in {*shared, own} or found.startswith(CAMERA_CONTRACT), (
                    f"{name_of(path)} imports {found}"
                )


@pytest.mark.parametrize("module", ["zenoh", "mcap", "rerun", "asc_rt.bus", "logs"])
def test_a_driver_knows_neither_bus_nor_log(module: str) -> None:
    assert not users(module, "drivers")


# --- 3. one home for each heavy library ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("module", "homes"),
    [
        ("zenoh", ["asc_rt/bus.py"]),
        ("mcap", ["logs/"]),
        ("rerun", ["logs/view"]),
        ("cv2", ["calibration/", "asc_rt/perception/", "drivers/cameras/", "logs/camera.py"]),
        ("av", ["drivers/cameras/azure.py"]),
        ("can", ["drivers/can/", "sim_hil/"]),
        ("mediapipe", ["asc_rt/perception/pose/backend_mediapipe.py"]),
        ("mujoco", ["sim_hil/"]),
        (
            "pydantic",
            ["asc_rt/cell_files.py", "asc_rt/config.py", "asc_rt/explain.py", "sim_hil/trials/suite_files.py"],
        ),
        ("typer", ["asc_rt/cli.py", "calibration/command.py", "asc_rt/synthesis/command.py", "logs/commands.py"]),
    ],
)
def test_each_library_is_imported_where_it_lives(module: str, homes: list[str]) -> None:
    strangers = [file for file in users(module, *PACKAGES) if not any(file.startswith(home) for home in homes)]
    assert not strangers


# --- 4. the control process is light ---------------------------------------------------------------------------------


def test_starting_the_control_process_loads_nothing_heavy() -> None:
    code = (
        "import sys, asc_rt.control; from asc_rt.config import load_cell; load_cell('fanuc-sim-truth');"
        "print(*sorted({m.partition('.')[0] for m in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = set(done.stdout.split())
    assert {"numpy", "pinocchio", "zenoh"} <= loaded
    assert not loaded & {"mcap", "rerun", "cv2", "mujoco", "typer", "tqdm", "pytest", "sim_hil", "logs"}


def test_the_command_line_loads_numpy_only_in_the_commands_that_need_it() -> None:
    """Each of them limits BLAS to one thread first, which is too late once numpy is there: replay would refuse."""
    code = "import sys, asc_rt.cli; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert not set(done.stdout.split()) & {"numpy", "numba", "pinocchio", "scipy", "cv2", "rerun"}


# --- 5. product and simulation ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", ["tests", "sim_hil", "pytest", "hypothesis"])
def test_the_product_never_imports_its_tests_or_its_simulators(module: str) -> None:
    assert not users(module, *PRODUCT)


def test_a_simulated_device_knows_no_driver() -> None:
    assert not users("drivers", "sim_hil")
