"""Where a tuning's input comes from: checksums of logs and files, and the version of this code."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import dscp_ros
from dscp_core.errors import InvalidInputError
from dscp_ros.planner.choice import ProblemChoice

_GIT_S = 10.0


def file_digests(path: Path) -> dict[str, str]:
    """SHA-256 of each MCAP file of a log, by name.

    Args:
        path: A file, or the directory of a bag.

    Raises:
        OSError: A file cannot be read.
    """
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    digests = {}
    for file in files:
        with file.open("rb") as stream:
            digests[file.name] = hashlib.file_digest(stream, "sha256").hexdigest()
    return digests


def check_new(
    path: Path, digests: Mapping[str, str], others: Mapping[Path, Mapping[str, str]]
) -> None:
    """Refuse a log that was given before: what is tuned on must not be held out as well.

    Args:
        path: The log.
        digests: Its checksums.
        others: Checksums of the logs before it.

    Raises:
        InvalidInputError: A file has the content of one of another log.
    """
    for other, known in others.items():
        if set(digests.values()) & set(known.values()):
            raise InvalidInputError("log", str(path), f"each log once; its content is in {other}")


def code_version() -> dict[str, Any]:
    """Version of this package, and the git revision where it runs from a repository.

    The revision is None where there is no repository, or no git.
    """
    folder = Path(dscp_ros.__file__).resolve().parent
    # A repository that happens to be above an installed package is another project's.
    tracked = _git(folder, "ls-files", "--error-unmatch", "__init__.py") is not None
    revision = _git(folder, "rev-parse", "HEAD") if tracked else None
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no") if tracked else None
    try:
        installed = version("dscp")
    except PackageNotFoundError:
        installed = None
    return {
        "version": installed,
        "git_revision": revision,
        "git_changed_files": None if changes is None else len(changes.splitlines()),
    }


def problem_source(choice: ProblemChoice) -> dict[str, Any]:
    """What a problem was named by, and the SHA-256 of its file if it is one of a Python file.

    Raises:
        OSError: The file has gone.
    """
    if not choice.is_file:
        return {"name": choice.text}
    path = Path(choice.text.rpartition(":")[0])
    return {"name": choice.text, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=_GIT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
