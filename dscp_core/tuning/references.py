"""Where the iterations of every state start: what they led to in the last epoch, kept on disk.

On disk, so that memory does not grow with the number of states. An epoch reads what the last one
wrote and writes to another file: one that is repeated after a kill reads the same again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dscp_core.files import FileWriteError
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.problem.declaration import OptimalControlProblem

Array = NDArray[np.float64]
Rows = NDArray[np.intp]


class ReferenceStore:
    """Reference vectors of numbered states, of this epoch and the last."""

    def __init__(self, folder: Path, size: int) -> None:
        """Look at a folder, where nothing is written before there is something to write.

        Args:
            folder: Of the checkpoint.
            size: Length R of a reference vector.
        """
        self._folder, self._size = folder, size
        self._epoch = 0

    def clear(self) -> None:
        """Forget what an earlier search left behind."""
        for path in reference_files(self._folder):
            path.unlink(missing_ok=True)

    def begin(self, epoch: int) -> None:
        """Write for this epoch from now on, and read what the last one has written."""
        self._epoch = epoch

    def read(self, rows: Rows) -> Array:
        """Reference vectors (n, R) of the last epoch; rows of NaN where there are none."""
        found = np.full((len(rows), self._size), np.nan)
        path = self._file(self._epoch - 1)
        if self._epoch == 0 or not path.exists():
            return found
        length = 8 * (self._size + 1)
        with path.open("rb") as file:
            for place, row in enumerate(rows):
                file.seek(int(row) * length)
                record = np.frombuffer(file.read(length))
                # The first number says which epoch wrote it: older ones, and gaps, do not count.
                if record.size == self._size + 1 and record[0] == self._epoch:
                    found[place] = record[1:]
        return found

    def write(self, rows: Rows, references: Array) -> None:
        """Keep reference vectors (n, R) for the next epoch; rows of NaN are left out.

        Raises:
            FileWriteError: They cannot be written.
        """
        usable = np.all(np.isfinite(references), axis=1)
        if not usable.any():
            return
        path = self._file(self._epoch)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            with path.open("r+b") as file:
                for row, reference in zip(rows[usable], references[usable], strict=True):
                    file.seek(int(row) * 8 * (self._size + 1))
                    file.write(np.concatenate([[self._epoch + 1.0], reference]).tobytes())
        except OSError as error:
            raise FileWriteError(f"{path}: {error.strerror or error}") from error

    def _file(self, epoch: int) -> Path:
        return reference_files(self._folder)[epoch % 2]


def reference_files(folder: Path) -> tuple[Path, Path]:
    """The files of a store in a folder, whether they exist or not."""
    return folder / "references.even.bin", folder / "references.odd.bin"


def reference_size(problem: OptimalControlProblem, planner: PlannerSettings) -> int:
    """Length R of the scaled reference vectors of a planner."""
    free = planner.terminal_time is TerminalTime.FREE
    return int(free) + (planner.intervals + 1) * (len(problem.states) + len(problem.controls))
