"""The house keeps its order: imports run downwards, without circles; a problem knows itself."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from dscp_core import problems

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("dscp_core", "msg_adapters", "dscp_ros")
MOST_LINES = 400
# From the ground up; a room imports its own floor's rooms only where it is named with them.
FLOORS = (
    ("errors", "files"),
    ("problem",),
    ("cone",),
    ("transcription",),
    ("scp",),
    ("gradients",),
    ("planning",),
    ("problems", "workers"),
    ("campaigns", "learning"),
    ("tuning", "studies"),
)
FACE = "dscp_core"
"""`dscp_core/__init__.py` hands names on, lazily: it imports nothing when it is read."""
# The paper's studies are about its own problems, and demos show the shipped ones.
MAY_NAME_PROBLEMS = ("dscp_core/problems/", "dscp_core/studies/", "dscp_ros/demo/")


def sources() -> list[Path]:
    return sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = problems.names()
MODULES = {module_of(path): path for path in sources()}


def imported(path: Path) -> set[str]:
    """Modules of this house that a file imports, for types and inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            members = {f"{node.module}.{alias.name}" for alias in node.names}
            inner = members & MODULES.keys()
            found |= inner or {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return (found & MODULES.keys()) - {module_of(path)}


IMPORTS = {module: imported(path) for module, path in MODULES.items() if module != FACE}


def floor(module: str) -> int:
    room = module.split(".")[1]
    (number,) = (n for n, rooms in enumerate(FLOORS) if room in rooms)
    return number


def test_every_room_of_the_core_has_a_floor() -> None:
    rooms = {module.split(".")[1] for module in MODULES if module.startswith("dscp_core.")}
    assert rooms == {room for rooms in FLOORS for room in rooms}


def test_imports_of_the_core_run_downwards() -> None:
    upwards = [
        f"{module} -> {other}"
        for module, others in IMPORTS.items()
        for other in others
        if module.startswith("dscp_core.") and other.startswith("dscp_core.")
        if floor(other) > floor(module)
    ]
    assert not upwards


def test_packages_import_one_way() -> None:
    wrong = [
        f"{module} -> {other}"
        for module, others in IMPORTS.items()
        for other in others
        if PACKAGES.index(other.split(".")[0]) > PACKAGES.index(module.split(".")[0])
    ]
    assert not wrong


def test_there_are_no_circles() -> None:
    TopologicalSorter(IMPORTS).prepare()  # raises CycleError, which names the circle


def test_the_core_and_only_the_core_knows_no_ros() -> None:
    foreign = ("rclpy", "_msgs", "rosidl", "builtin_interfaces")
    for module, path in MODULES.items():
        if not module.startswith("dscp_core"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not [n for n in names if any(f in n for f in foreign)], path


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_files_are_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


def test_nothing_but_a_problem_knows_it_by_name() -> None:
    found = []
    for path in sources():
        place = str(path.relative_to(ROOT))
        if place.startswith(MAY_NAME_PROBLEMS):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and node.value in NAMES:
                found.append(f"{place}:{node.lineno}: {node.value!r}")
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                tuple(f"dscp_core.problems.{name}" for name in NAMES)
            ):
                found.append(f"{place}:{node.lineno}: imports {node.module}")
    assert not found
