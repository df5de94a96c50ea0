"""Examples, run as a user runs them."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.image
import numpy as np

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"


@dataclass(frozen=True)
class ExampleRun:
    """What an example printed and left behind.

    Attributes:
        printed: On stdout.
        output: Its folder.
    """

    printed: str
    output: Path

    def numbers(self, start: str) -> list[float]:
        """Numbers of the only printed line that starts with this, except those in words."""
        (found,) = (x for x in self.printed.splitlines() if x.strip().startswith(start))
        words = found.strip().removeprefix(start).replace(",", " ").replace(":", " ").split()
        return [float(word) for word in words if _is_number(word)]


def run_example(name: str, folder: Path) -> ExampleRun:
    """Run an example into a folder that is not there yet, and look at its figure.

    Args:
        name: Of the file, without suffix.
        folder: Where to work; not the repository.
    """
    output = folder / "new" / "folder"
    search = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py"), "--output", str(output)],
        env={**os.environ, "PYTHONPATH": search},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    check_figure(output / f"{name}.png")
    return ExampleRun(done.stdout, output)


def check_figure(path: Path) -> None:
    """A picture of some size in which something is drawn, in colour."""
    pixels = matplotlib.image.imread(path)[..., :3]
    height, width, _ = pixels.shape
    assert height >= 300
    assert width >= 800
    background = np.all(pixels == 1.0, axis=2)
    assert 0.5 < background.mean() < 0.99
    assert np.ptp(pixels, axis=2).max() > 0.3


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
