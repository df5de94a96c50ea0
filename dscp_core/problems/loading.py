"""Problems that are not shipped: of an installed package, or of a Python file.

A problem's file is code. Callers take its name from a command line or from a parameter file at the
start, never from data.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem

ENTRY_POINT_GROUP = "dscp.problems"
FILE_MARK = ".py:"


@dataclass(frozen=True)
class ProblemFamily:
    """A problem that comes in several formulations.

    Attributes:
        formulations: Their names, the default first.
        make: Declares the problem in one of them.
    """

    formulations: tuple[str, ...]
    make: Callable[[str], OptimalControlProblem]


def installed() -> tuple[str, ...]:
    """Names that installed packages offer in the entry-point group ``dscp.problems``."""
    return tuple(sorted(point.name for point in entry_points(group=ENTRY_POINT_GROUP)))


def from_entry_point(name: str) -> Any:
    """What an installed package offers under a name.

    Raises:
        InvalidInputError: It cannot be imported.
    """
    (point, *_) = entry_points(group=ENTRY_POINT_GROUP, name=name)
    try:
        return point.load()
    except (Exception, SystemExit) as error:
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
    module = _module(path, text)
    if not hasattr(module, name):
        offered = [n for n, value in vars(module).items() if _may_be_problem(value)]
        found = f"; the file has {', '.join(offered)}" if offered else "; the file has no problem"
        raise InvalidInputError("problem", text, f"a name in {path}{found}")
    return getattr(module, name)


def family_of(text: str, found: Any) -> ProblemFamily:
    """A family, whatever a name or file gave: a problem, a function that makes one, a family.

    Raises:
        InvalidInputError: It is none of these.
    """
    if isinstance(found, ProblemFamily):
        return found
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
    except DscpError:
        raise
    except (Exception, SystemExit) as error:
        raise InvalidInputError(
            "problem", text, f"a function that makes a problem: {_told(error)}"
        ) from error
    if not isinstance(made, OptimalControlProblem):
        raise InvalidInputError(
            "problem",
            f"{text}() returned {type(made).__name__}",
            "a function without arguments that returns an OptimalControlProblem",
        )
    return made


def _module(path: Path, text: str) -> ModuleType:
    """The module of a file, run once per content."""
    try:
        path = path.resolve()
        content = path.read_bytes()
    except OSError as error:
        raise InvalidInputError(
            "problem", text, f"a readable Python file ({error.strerror})"
        ) from None
    digest = hashlib.sha256(str(path).encode() + b"\0" + content).hexdigest()[:16]
    name = f"dscp_problem_{path.stem}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InvalidInputError("problem", text, "a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        exec(compile(content, path, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        if isinstance(error, DscpError):
            raise
        raise InvalidInputError(
            "problem", text, f"a Python file that can be run: {_told(error)}"
        ) from error
    # Workers cannot import it by name: its functions travel by value.
    cloudpickle.register_pickle_by_value(module)
    return module


def _may_be_problem(value: Any) -> bool:
    return isinstance(value, OptimalControlProblem | ProblemFamily)


def _told(error: BaseException) -> str:
    place = ""
    if isinstance(error, SyntaxError):
        return f"line {error.lineno}: {error.msg}"
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_name == "<module>" and not place:
            place = f"line {trace.tb_lineno}: "
        trace = trace.tb_next
    return f"{place}{type(error).__name__}: {error}"
