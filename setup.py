"""What colcon needs and pyproject.toml cannot say; everything else is read from pyproject.toml.

colcon runs this file in its build directory, where pyproject.toml is missing, so the name, the
version, the packages and the console script are passed on explicitly. The files below share/ and
lib/ make the ROS package `dscp_ros`.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).resolve().parent
ROS_PACKAGE = "dscp_ros"
SHARED_FOLDERS = ("config", "bags")


def shared_files(folder: str) -> list[tuple[str, list[str]]]:
    """Returns (destination, sources) for a folder and every folder below it.

    Python files are left out: they make the data, and are no part of it.
    """
    by_folder: dict[Path, list[str]] = {}
    for path in sorted((ROOT / folder).rglob("*")):
        relative = path.relative_to(ROOT)
        hidden = any(part.startswith((".", "__")) for part in relative.parts)
        if path.is_file() and path.suffix != ".py" and not hidden:
            by_folder.setdefault(relative.parent, []).append(str(relative))
    return [(f"share/{ROS_PACKAGE}/{parent}", files) for parent, files in by_folder.items()]


pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
project = pyproject["project"]

distribution = setup(
    name=project["name"],
    version=project["version"],
    license="Apache-2.0",
    packages=find_packages(
        ROOT, include=pyproject["tool"]["setuptools"]["packages"]["find"]["include"]
    ),
    package_data=pyproject["tool"]["setuptools"]["package-data"],
    entry_points={
        "console_scripts": [f"{name} = {target}" for name, target in project["scripts"].items()]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{ROS_PACKAGE}"]),
        (f"share/{ROS_PACKAGE}", ["package.xml"]),
        (f"lib/{ROS_PACKAGE}", ["scripts/planner", "scripts/replay"]),
        *(entry for folder in SHARED_FOLDERS for entry in shared_files(folder)),
    ],
)

# colcon stops setup() before it builds and reads the attributes back from their repr, which for
# the SpecifierSet that setuptools makes of `requires-python` is no Python.
distribution.python_requires = project["requires-python"]
distribution.metadata.python_requires = project["requires-python"]
