"""A bag's place on disk while it is written: under a temporary name, until it is complete."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO

from dscp_ros.bag.errors import BagExistsError
from dscp_ros.bag.metadata import METADATA_FILE

MCAP_SUFFIX = ".mcap"


class PartialBag:
    """Creates the partial bag, and moves it to its place when it is complete.

    Args:
        path: Where the bag will be: a single file if it ends in `.mcap`, else a directory.
        overwrite: Whether a bag that is there may be replaced.

    Attributes:
        path: Where the bag will be.
        partial_path: Where it is now.
        file_name: Name of the MCAP file in the complete bag.
        stream: The MCAP file, open for writing.

    Raises:
        BagExistsError: If the path is taken.
        OSError: If the file cannot be created.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self.path = path
        self._overwrite = overwrite
        self._single_file = path.suffix == MCAP_SUFFIX
        self.file_name = path.name if self._single_file else f"{path.name}_0{MCAP_SUFFIX}"
        self._check_free()
        self.partial_path, self.stream = self._create()

    def complete(self, metadata_text: str) -> None:
        """Writes everything to disk, with `metadata.yaml` in a directory.

        Raises:
            OSError: If that fails.
        """
        self.stream.flush()
        os.fsync(self.stream.fileno())
        self.stream.close()
        if not self._single_file:
            with (self.partial_path / METADATA_FILE).open("w", encoding="utf-8") as file:
                file.write(metadata_text)
                file.flush()
                os.fsync(file.fileno())

    def move_into_place(self) -> None:
        """Gives the complete bag its name.

        Raises:
            BagExistsError: If the path was taken in the meantime.
            OSError: If renaming fails.
        """
        self._check_free(f"; the complete bag is in {self.partial_path}")
        replaced: Path | None = None
        if self.path.is_dir():
            # A directory that is not empty cannot be replaced in one step.
            replaced = Path(tempfile.mkdtemp("", f"{self.path.name}.replaced-", self.path.parent))
            os.replace(self.path, replaced)
        os.replace(self.partial_path, self.path)
        if replaced is not None:
            shutil.rmtree(replaced)

    def abandon(self, *, keep: bool) -> Path | None:
        """Closes the file, and deletes it unless it is to be kept; returns what is left."""
        # A full disk fails here again, on the last buffer; what was flushed before stays.
        with contextlib.suppress(OSError):
            self.stream.close()
        if keep:
            return self.partial_path
        if self._single_file:
            self.partial_path.unlink(missing_ok=True)
        else:
            shutil.rmtree(self.partial_path)
        return None

    def _create(self) -> tuple[Path, BinaryIO]:
        parent = self.path.parent
        parent.mkdir(parents=True, exist_ok=True)
        prefix = f"{self.path.name}.partial-"
        if self._single_file:
            handle, name = tempfile.mkstemp(MCAP_SUFFIX, prefix, parent)
            _apply_umask(Path(name), 0o666)
            return Path(name), os.fdopen(handle, "wb")
        directory = Path(tempfile.mkdtemp("", prefix, parent))
        _apply_umask(directory, 0o777)
        return directory, (directory / self.file_name).open("wb")

    def _check_free(self, addition: str = "") -> None:
        if not os.path.lexists(self.path):
            return
        if not self._overwrite:
            raise BagExistsError(f"{self.path} exists and is not overwritten{addition}")
        if self.path.is_dir() == self._single_file:
            raise BagExistsError(f"{self.path} is not replaced: it is no such bag{addition}")
        if self.path.is_dir():
            others = sorted(
                entry.name
                for entry in self.path.iterdir()
                if entry.name != METADATA_FILE and entry.suffix != MCAP_SUFFIX
            )
            if others:
                raise BagExistsError(
                    f"{self.path} is not replaced: it holds more than a bag "
                    f"({', '.join(others)}){addition}"
                )


def _apply_umask(path: Path, mode: int) -> None:
    """Gives a temporary file the permissions of a normal one."""
    umask = os.umask(0)
    os.umask(umask)
    path.chmod(mode & ~umask)
