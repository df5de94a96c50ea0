"""What the documents contain that can be run: Python blocks and commands."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCUMENTS = tuple(
    sorted(
        path.relative_to(ROOT).as_posix()
        for pattern in ("*.md", "docs/**/*.md", "bags/*.md", "examples/**/*.md")
        for path in ROOT.glob(pattern)
    )
)

# Marks of a block with commands, and what a command begins with.
_SHELLS = ("", "sh", "bash", "console", "shell")
_PROGRAMS = (("dscp",), ("python", "-m"))


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        document: Path below the root.
        line: Of its first line of content, from 1.
        language: As marked; empty without a mark.
        text: Its content.
    """

    document: str
    line: int
    language: str
    text: str


@dataclass(frozen=True)
class Command:
    """A command of this project.

    Attributes:
        place: ``document:line``.
        words: After `.venv/bin/`, which it may begin with, and without comments.
        exit_code: What the comment beside it says, or 0.
    """

    place: str
    words: tuple[str, ...]
    exit_code: int = 0

    @property
    def is_dscp(self) -> bool:
        """Whether it is one of `dscp`, not of Python."""
        return self.words[0] == "dscp"

    def __str__(self) -> str:
        return f"{self.place} {shlex.join(self.words)}"


@cache
def text_of(document: str) -> str:
    """Content of a document."""
    return (ROOT / document).read_text(encoding="utf-8")


@cache
def blocks(document: str) -> tuple[Block, ...]:
    """Fenced blocks in order."""
    found: list[Block] = []
    language, start, lines = None, 0, list[str]()
    for number, line in enumerate(text_of(document).splitlines(), start=1):
        fence = re.match(r"\s*```(\S*)", line)
        if fence is None:
            lines.append(line)
        elif language is None:
            language, start, lines = fence[1], number + 1, []
        else:
            found.append(Block(document, start, language, "\n".join(lines) + "\n"))
            language = None
    assert language is None, f"{document}:{start}: a block does not end"
    return tuple(found)


def python_blocks(document: str) -> tuple[Block, ...]:
    """Blocks of Python in order."""
    return tuple(block for block in blocks(document) if block.language == "python")


@cache
def commands(document: str) -> tuple[Command, ...]:
    """Commands of this project in the document's blocks, in order."""
    return tuple(
        command
        for block in blocks(document)
        if block.language in _SHELLS
        for command in commands_of(block.text, block.document, block.line)
    )


def commands_of(text: str, document: str, first_line: int) -> Iterator[Command]:
    """Commands of this project in a text that a shell would run, or shows what it ran."""
    lines = text.splitlines()
    # Where prompts are shown, all else is output.
    prompted = any(line.lstrip().startswith("$ ") for line in lines)
    number = 0
    while number < len(lines):
        place = f"{document}:{first_line + number}"
        line = lines[number].strip()
        while line.endswith("\\") and number + 1 < len(lines):
            number += 1
            line = line[:-1] + " " + lines[number].strip()
        number += 1
        if prompted and not line.startswith("$ "):
            continue
        stated = re.search(r"exit code (\d+)", line)
        code = int(stated[1]) if stated else 0
        # Help texts have remarks in parentheses, two spaces behind the command.
        shown = re.sub(r"\s{2,}\(.*\)$", "", line.removeprefix("$ "))
        for words in _split(shown):
            if any(words[: len(program)] == program for program in _PROGRAMS):
                yield Command(place, words, code)


def _split(line: str) -> Iterator[tuple[str, ...]]:
    """The commands of a line, each as words."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="&;|<>")
    lexer.whitespace_split = True
    words: list[str] = []
    try:
        tokens = list(lexer)
    except ValueError:  # output with a lone quote
        return
    for token in [*tokens, ";"]:
        if set(token) <= set("&;|<>"):
            if words:
                yield tuple(words)
            words = []
        else:
            words.append(token.removeprefix(".venv/bin/") if not words else token)
