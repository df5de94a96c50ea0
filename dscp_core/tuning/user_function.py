"""The user's own loss function, read from a file."""

from __future__ import annotations

import hashlib
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dscp_core.errors import InvalidInputError


@dataclass(frozen=True)
class UserFunction:
    """A function and its source, which travels to workers that do not have the file.

    Attributes:
        file: Where it was read from.
        name: Name of the function.
        source: Text of the file.
    """

    file: str
    name: str
    source: str

    @staticmethod
    def read(text: str) -> UserFunction:
        """Read ``FILE.py:FUNCTION``, and run the file once to see that the function is there.

        Raises:
            InvalidInputError: No such file or function, or the file cannot be run.
        """
        path, _, name = text.rpartition(":")
        try:
            source = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidInputError(
                "loss", text, f"FILE.py:FUNCTION with a readable file ({error})"
            ) from None
        function = UserFunction(str(Path(path).resolve()), name, source)
        function.load()
        return function

    @property
    def sha256(self) -> str:
        """Hash of the source."""
        return hashlib.sha256(self.source.encode("utf-8")).hexdigest()

    def load(self) -> Callable[..., Any]:
        """The function.

        Raises:
            InvalidInputError: The file cannot be run, or has no such function.
        """
        module = types.ModuleType("dscp_user_loss")
        module.__file__ = self.file
        try:
            exec(compile(self.source, self.file, "exec"), module.__dict__)
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            raise InvalidInputError(
                "loss", self.file, f"a file that runs ({type(error).__name__}: {error})"
            ) from None
        function: Any = getattr(module, self.name, None)
        if not callable(function):
            raise InvalidInputError("loss", self.name, f"a function in {self.file}")
        checked: Callable[..., Any] = function
        return checked
