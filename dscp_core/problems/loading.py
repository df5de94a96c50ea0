"""Problems that are not shipped: of an installed package, or of a Python file.

A problem's file is code. Callers take its name from a command line or from a parameter file at the
start, never from data. Its folder is where it can import from, after all that is installed.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem

ENTRY_POINT_GROUP = "dscp.problems"
FILE_MARK = ".py:"
_LARGEST_FILE = 10_000_000  # bytes; a problem's source is a thousandth of this


@dataclass(frozen=True)
class ProblemFamily:
    """A problem that comes in several formulations.

    Attributes:
        formulations: Their names, the default first.
        make: Declares the problem in one of them.

    Example:
        >>> from dscp_core import ProblemFamily, problems
        >>> family = ProblemFamily(("quadratic", "printed"), lambda f: problems.get("entry", f))
        >>> family.make("printed").formulation
        'printed'
    """

    formulations: tuple[str, ...]
    make: Callable[[str], OptimalControlProblem]


def installed() -> tuple[str, ...]:
    """Names that installed packages offer in the entry-point group ``dscp.problems``."""
    return tuple(sorted({point.name for point in entry_points(group=ENTRY_POINT_GROUP)}))


def from_entry_point(name: str) -> Any:
    """What an installed package offers under a name.

    Raises:
        InvalidInputError: It cannot be imported, or several packages offer different things.
    """
    point, *others = entry_points(group=ENTRY_POINT_GROUP, name=name)
    if any(other.value != point.value for other in others):
        offered = ", ".join(sorted(p.value for p in (point, *others)))
        raise InvalidInputError("problem", name, f"offered once; installed packages have {offered}")
    try:
        return point.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise InvalidInputError(
            "problem", name, f"an entry point that can be loaded: {_told(error)}"
        ) from error


def from_file(text: str) -> Any:
    """What ``FILE.py:NAME`` means: an attribute of the module in that file, which is run.

    Raises:
        InvalidInputError: No such file, no Python, no such name in it, or it raises.
    """
    path_text, _, name = text.rpartition(":")
    path = Path(path_text)
    if not name.isidentifier():
        raise InvalidInputError("problem", text, "FILE.py:NAME with the name of a Python variable")
    module = vars(_module(path, text))
    if name not in module:
        offered = [n for n, value in module.items() if _may_be_problem(value)]
        found = f"; the file has {', '.join(offered)}" if offered else "; the file has no problem"
        raise InvalidInputError("problem", text, f"a name in {path}{found}")
    return module[name]


def family_of(text: str, found: Any) -> ProblemFamily:
    """A family, whatever a name or file gave: a problem, a function that makes one, a family.

    Raises:
        InvalidInputError: It is none of these.
    """
    if isinstance(found, ProblemFamily):
        return replace(found, make=lambda name: _made(text, lambda: found.make(name)))
    if isinstance(found, OptimalControlProblem):
        return ProblemFamily((), lambda _: found)
    if callable(found):
        return ProblemFamily((), lambda _: _made(text, found))
    raise InvalidInputError(
        "problem",
        f"{text}, {type(found).__name__}",
        "an OptimalControlProblem, a function that returns one, or a ProblemFamily",
    )


def _made(text: str, function: Callable[[], Any]) -> OptimalControlProblem:
    try:
        made = function()
    except (DscpError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise InvalidInputError(
            "problem", text, f"a function that makes a problem: {_told(error)}"
        ) from error
    if not isinstance(made, OptimalControlProblem):
        raise InvalidInputError(
            "problem",
            f"{text}() returned {type(made).__name__}",
            "a function that returns an OptimalControlProblem",
        )
    return made


def _module(path: Path, text: str) -> ModuleType:
    """The module of a file, run once per content."""
    path, content = _content(path, text)
    digest = hashlib.sha256(os.fsencode(path) + b"\0" + content).hexdigest()[:16]
    name = f"dscp_problem_{path.stem}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InvalidInputError("problem", text, "a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    folder, known = str(path.parent), set(sys.modules)
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        exec(compile(content, path, "exec", dont_inherit=True), module.__dict__)
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, DscpError | KeyboardInterrupt):
            raise
        raise InvalidInputError(
            "problem", text, f"a Python file that can be run: {_told(error)}"
        ) from error
    # Workers elsewhere cannot import it, or what lies beside it: their functions travel by value.
    neighbours = [
        sys.modules[other]
        for other in set(sys.modules) - known
        if Path(getattr(sys.modules[other], "__file__", None) or "").parent == path.parent
    ]
    for own in (module, *neighbours):
        cloudpickle.register_pickle_by_value(own)
    return module


def _content(path: Path, text: str) -> tuple[Path, bytes]:
    """The absolute path of a file, and what is in it.

    Raises:
        InvalidInputError: It is no file, too large, or cannot be read.
    """
    try:
        path = path.resolve()
        size = path.stat().st_size
        found = "a directory" if path.is_dir() else "a device or pipe" if not path.is_file() else ""
        content = path.read_bytes() if not found and size <= _LARGEST_FILE else b""
    except (OSError, ValueError) as error:  # a null byte in the name is the latter
        reason = getattr(error, "strerror", None) or error
        raise InvalidInputError("problem", text, f"a readable Python file ({reason})") from None
    if found:
        raise InvalidInputError("problem", text, f"a Python file, not {found}")
    if size > _LARGEST_FILE:
        raise InvalidInputError("problem", f"{text}, {size} bytes", f"<= {_LARGEST_FILE} bytes")
    return path, content


def _may_be_problem(value: Any) -> bool:
    return isinstance(value, OptimalControlProblem | ProblemFamily)


def _told(error: BaseException) -> str:
    """What an error says, and where outside of this file it came from."""
    if isinstance(error, SyntaxError):
        place = f"{Path(error.filename).name} line {error.lineno}: " if error.filename else ""
        return f"{place}{error.msg}"
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename != __file__]
    own = [frame for frame in frames if not frame.filename.startswith("<frozen ")]
    place = f"{Path(own[0].filename).name} line {own[0].lineno}: " if own else ""
    return f"{place}{type(error).__name__}: {' '.join(str(error).split())}"
