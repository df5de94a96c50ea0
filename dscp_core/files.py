"""Files that are there as a whole, or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from dscp_core.errors import DscpError


class FileWriteError(DscpError):
    """A file that could not be written; one that was there before is unchanged."""


def replace_file(path: Path, content: bytes) -> None:
    """Write a file so that at any moment the old or the new content is there, never a part.

    Raises:
        FileWriteError: It cannot be written; the old file is unchanged.
    """
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise FileWriteError(f"{path}: {error.strerror or error}") from error
