"""What pip and colcon make of this repository, and that its lists agree with each other."""

from __future__ import annotations

import ast
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("dscp_core", "msg_adapters", "dscp_ros")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()

REQUIREMENTS = [
    Requirement(line)
    for lines in [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    for line in lines
]
CONSTRAINTS = {
    canonicalize_name(constraint.name): constraint
    for line in (ROOT / "constraints.txt").read_text().splitlines()
    if line and not line.startswith("#")
    for constraint in [Requirement(line)]
}
# ROS packages: installed from wheels or from apt, so package.xml declares them too.
ROS_MODULE = re.compile(r"rclpy|ament_\w+|std_srvs|\w+_(msgs|interfaces)")


def imported_modules() -> Iterator[str]:
    """Yields the top-level name of every module that the packages import, lazily or not."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    yield from (alias.name.partition(".")[0] for alias in node.names)
                elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                    yield node.module.partition(".")[0]


def shared_files() -> set[Path]:
    """Returns the data files that an installation has to hold, relative to the repository."""
    return {
        path.relative_to(ROOT)
        for folder in ("config", "bags")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the repository, so that no build touches the real one."""
    ignored = shutil.ignore_patterns(
        ".*", "build", "install", "log", "out", "dist", "*.egg-info", "__pycache__"
    )
    return Path(shutil.copytree(ROOT, tmp_path_factory.mktemp("ws") / "src", ignore=ignored))


def run(*command: str | Path, cwd: Path) -> str:
    """Runs a command, returns its standard output, and shows everything when it fails."""
    result = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def test_versions_agree() -> None:
    assert PROJECT["version"] == MANIFEST.findtext("version")


def test_every_direct_dependency_is_pinned_to_a_version_that_it_allows() -> None:
    names = {canonicalize_name(requirement.name) for requirement in REQUIREMENTS}
    assert set(CONSTRAINTS) == names
    for requirement in REQUIREMENTS:
        pins = list(CONSTRAINTS[canonicalize_name(requirement.name)].specifier)
        assert [pin.operator for pin in pins] == ["=="], requirement.name
        assert requirement.specifier.contains(pins[0].version), requirement.name


def test_installed_versions_are_the_pinned_ones() -> None:
    for name, constraint in CONSTRAINTS.items():
        try:
            installed = Version(importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            continue  # an extra that this environment leaves out
        assert constraint.specifier.contains(installed.public), f"{name} {installed}"


def test_every_import_is_declared() -> None:
    declared = {canonicalize_name(requirement.name) for requirement in REQUIREMENTS}
    rosdeps = {element.text for element in MANIFEST.iter("exec_depend")}
    distributions = importlib.metadata.packages_distributions()
    missing = set()
    for module in set(imported_modules()) - set(sys.stdlib_module_names) - set(PACKAGES):
        if ROS_MODULE.fullmatch(module):
            known = module in rosdeps
        else:
            providers = map(canonicalize_name, distributions.get(module, [module]))
            known = not declared.isdisjoint(providers)
        if not known:
            missing.add(module)
    assert not missing


@pytest.mark.parametrize("command", ["plan", "gradient"])
def test_planning_needs_neither_ros_nor_torch(command: str) -> None:
    code = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        root = name.partition('.')[0]\n"
        "        if root in ('rclpy', 'torch') or root.endswith(('_msgs', '_interfaces')):\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "import dscp_core, dscp_ros\n"
        "from dscp_ros.cli.main import main\n"
        f"sys.exit(main([{command!r}, '--help']))\n"
    )
    assert "usage: dscp" in run(sys.executable, "-c", code, cwd=ROOT)


@pytest.mark.slow
def test_wheel_holds_code_data_and_license(source: Path, tmp_path: Path) -> None:
    run(
        *(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"),
        *("--wheel-dir", tmp_path, source),
        cwd=tmp_path,
    )
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"dscp-{PROJECT['version']}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        stem = wheel.name.removesuffix("-py3-none-any.whl")
        metadata = archive.read(f"{stem}.dist-info/METADATA").decode()
        entry_points = archive.read(f"{stem}.dist-info/entry_points.txt").decode()
    code = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for pattern in ("*.py", "py.typed", "*.yaml", "*.safetensors")
        for path in (ROOT / package).rglob(pattern)
    }
    data = {f"{stem}.data/data/share/dscp_ros/{path}" for path in shared_files()}
    assert code | data <= names
    assert {name.partition("/")[0] for name in names if ".d" not in name} == set(PACKAGES)
    assert "License: Apache-2.0" in metadata
    assert any(name.endswith("/LICENSE") for name in names)
    assert "dscp = dscp_ros.cli.main:main" in entry_points
    assert "planner" not in entry_points, "too general a name for everyone's PATH"


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--symlink-install",)], ids=["copy", "symlink"])
def test_colcon_build(source: Path, tmp_path: Path, options: tuple[str, ...]) -> None:
    pytest.importorskip("colcon_core")
    colcon = (sys.executable, "-m", "colcon", "--log-base", tmp_path / "log")
    before = sorted(source.rglob("*"))

    # An invalid package.xml would only make this a plain `(python)` package.
    listed = run(*colcon, "list", "--base-paths", source, cwd=tmp_path)
    assert listed.split() == ["dscp_ros", str(source), "(ros.ament_python)"]

    run(*colcon, "build", "--base-paths", source, *options, cwd=tmp_path)
    assert sorted(source.rglob("*")) == before, "a build leaves nothing in the source tree"
    prefix = tmp_path / "install" / "dscp_ros"
    assert (prefix / "share/ament_index/resource_index/packages/dscp_ros").is_file()
    assert (prefix / "share/dscp_ros/package.xml").is_file()
    installed = {
        path.relative_to(prefix / "share/dscp_ros")
        for folder in ("config", "bags")
        for path in (prefix / "share/dscp_ros" / folder).rglob("*")
        if path.is_file()
    }
    assert installed == shared_files()

    # What `ros2 run dscp_ros NAME` starts. Their code has to come from this build, though this
    # interpreter may see an editable installation of the repository too.
    for executable in ("planner", "replay", "dscp"):
        assert os.access(prefix / "lib/dscp_ros" / executable, os.X_OK)
    root = Path(
        run(
            "sh",
            "-c",
            f'. install/setup.sh && exec "{sys.executable}" -c '
            '"import dscp_ros; print(dscp_ros.__file__)"',
            cwd=tmp_path,
        ).strip()
    )
    assert root.is_relative_to(tmp_path)
    for executable in ("dscp", "replay"):
        shown = run(
            *("sh", "-c"),
            f'. install/setup.sh && exec install/dscp_ros/lib/dscp_ros/{executable} "$@"',
            *("sh", "--help"),
            cwd=tmp_path,
        )
        assert shown.startswith("usage: ")
