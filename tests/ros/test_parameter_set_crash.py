"""Parameter sets when processes are killed and disks are full."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from parameter_set_support import NEW, OLD, fitting_network

from dscp_ros.parameter_set import ParameterSetError, load, save

TESTS = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What `parameter_set_support`'s programs print; they fork, so they have a process."""
    search = os.pathsep.join((str(TESTS), str(TESTS.parent)))
    done = subprocess.run(
        [sys.executable, "-m", "parameter_set_support", str(tmp_path_factory.mktemp("sets"))],
        env={**os.environ, "PYTHONPATH": search},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return dict(part.split("\n", 1) for part in done.stdout.split("== ")[1:])


def test_kill_at_any_moment_leaves_a_whole_set(printed: dict[str, str]) -> None:
    times = int(printed["killed"].split()[1])
    assert times > 20  # three files, each created, renamed and read again


def test_a_set_can_be_loaded_while_it_is_replaced(printed: dict[str, str]) -> None:
    assert "seen both" in printed["replaced"]


def test_a_file_that_cannot_grow_leaves_the_old_set(printed: dict[str, str]) -> None:
    assert printed["limited"].count("File too large") >= 3


def test_a_full_disk_leaves_the_old_set(tmp_path: Path, printed: dict[str, str]) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        # Without the right to mount, a limit of the file size is what is left; see above.
        assert "File too large" in printed["limited"]
        return
    try:
        before = save(disk / "set", OLD)
        with pytest.raises(ParameterSetError, match=r"not written: .*No space left on device"):
            save(disk / "set", NEW, fitting_network(), overwrite=True)
        assert load(disk / "set").identifier == before.identifier
        assert [entry.name for entry in disk.iterdir()] == ["set"]
    finally:
        subprocess.run(["umount", str(disk)], check=True)
