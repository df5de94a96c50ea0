"""The documents: every Python block and every command runs, and what they name is there."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from documentation_support import (
    DOCUMENTS,
    ROOT,
    Block,
    Command,
    commands,
    commands_of,
    python_blocks,
    text_of,
)

from dscp_ros.cli.main import COMMANDS, build_parser

CALL = "import sys; from dscp_ros.cli.main import main; sys.exit(main())"

# Commands that are only parsed, and why; all others are run.
PARSED_ONLY = {
    ("planner",): "lives until it is stopped; tests/ros starts it",
    ("guide",): "lives until it is stopped; tests/ros/test_guidance_node.py",
    ("replay",): "takes as long as the flight, and wants a listener; tests/ros/test_replay.py",
    ("bag", "record"): "lives until it is stopped; tests/ros/test_bag_record.py",
    ("simulate",): "many flights; tests/cli/test_simulate_command.py",
    ("study",): "minutes even with --quick; tests/cli/test_study_command.py",
    ("train",): "minutes; tests/cli/test_train_command.py",
    ("evaluate",): "minutes; tests/core/learning",
    ("tune",): "minutes; tests/cli/test_tune_command.py",
}
# Files of the reader's, which a document names as examples.
READERS_FILES = re.compile(
    r"(BAG|DAMAGED_BAG|GOOD_BAG|flip\.mcap|flight\.partial-.*|saved|flight|my_.*\.py:.*|FILE\.py:NAME|VEHICLE\.yaml)"
)

# What stands before a document's Python blocks here, because its text tells it in words.
PRELUDES = {
    "docs/node.md": """
# The listener of the document waits for messages for ever.
import rclpy
rclpy.spin = lambda node: rclpy.spin_once(node, timeout_sec=0.1)
""",
    "docs/tuning.md": """
# "lists of Sample(state, log)", three states here; and a set where one stands in the document.
from pathlib import Path
from dscp_core import Planner, problems
from dscp_core.tuning.tuner import Sample
from dscp_ros.parameter_set import save
start = Planner(problems.get("entry")).initial_state
training, held_out = [Sample(start, "a.mcap")] * 2, [Sample(start, "b.mcap")]
Path("sets").mkdir()
save("sets/mine", {"problem": "entry", "intervals": 50}, None, {"held_out": {"after": {}}})
""",
}
# It names what was, too.
HISTORY = "CHANGELOG.md"
# Whole documents whose blocks are not run, and why.
NOT_RUN: dict[str, str] = {}

WITH_PYTHON = [document for document in DOCUMENTS if python_blocks(document)]
ALL_COMMANDS = [command for document in DOCUMENTS for command in commands(document)]
HELP_COMMANDS = [
    command
    for name in COMMANDS
    for command in commands_of(
        getattr(importlib.import_module(COMMANDS[name].module), "EPILOG", ""), f"{name} --help", 1
    )
]


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A folder that looks like the repository's root, where files can be written."""
    for entry in ROOT.iterdir():
        if entry.name not in ("out", ".git") and not entry.name.endswith("_cache"):
            (tmp_path / entry.name).symlink_to(entry)
    return tmp_path


def run(arguments: list[str], folder: Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    search = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(search), "MPLBACKEND": "agg"}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
    )


def reason_to_parse_only(command: Command) -> str | None:
    """Why a command is not run; None for one that is."""
    if not command.is_dscp:
        return "the demo and the benchmarks take minutes; make demo is a test of its own"
    for words, reason in PARSED_ONLY.items():
        if command.words[1 : 1 + len(words)] == words:
            return reason
    if any(READERS_FILES.fullmatch(word) for word in command.words):
        return "names a file of the reader's"
    return None


def test_there_are_documents() -> None:
    assert {"README.md", "docs/entry.md", "docs/node.md", "docs/tuning.md"} <= set(DOCUMENTS)
    assert len(WITH_PYTHON) >= 3
    assert len(ALL_COMMANDS) >= 20


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("document", WITH_PYTHON)
def test_python_blocks_run_in_order(document: str, workspace: Path) -> None:
    if document in NOT_RUN:
        pytest.skip(NOT_RUN[document])
    result = run(["-c", program(document)], workspace, 280.0)
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"


def program(document: str) -> str:
    """All blocks of a document in one namespace, with the document's lines in tracebacks."""
    parts = [f"exec(compile({PRELUDES.get(document, '')!r}, 'prelude', 'exec'), space)"]
    parts += [
        f"exec(compile({padded(block)!r}, {document!r}, 'exec'), space)"
        for block in python_blocks(document)
    ]
    # Worker processes import the main module again.
    main = "\n    ".join(["space = {'__name__': 'document'}", *parts])
    return f"if __name__ == '__main__':\n    {main}\n"


def padded(block: Block) -> str:
    return "\n" * (block.line - 1) + block.text


@pytest.mark.parametrize("command", [*ALL_COMMANDS, *HELP_COMMANDS], ids=str)
def test_commands_parse(command: Command) -> None:
    if command.is_dscp:
        words = command.words[1:]
        name = next((word for word in words if not word.startswith("-")), None)
        if {"--help", "--version"} & set(words) or name == "COMMAND":
            return
        build_parser(name).parse_args(list(words))
    else:
        assert importlib.util.find_spec(command.words[2]) is not None


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "document", [d for d in DOCUMENTS if any(not reason_to_parse_only(c) for c in commands(d))]
)
def test_commands_run_in_order(document: str, workspace: Path) -> None:
    for command in commands(document):
        if reason_to_parse_only(command) is None:
            result = run(["-c", CALL, *command.words[1:]], workspace, 120.0)
            assert result.returncode == command.exit_code, f"{command}\n{result.stderr}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [c for c in HELP_COMMANDS if reason_to_parse_only(c) is None], ids=str
)
def test_commands_of_the_help_run(command: Command, workspace: Path) -> None:
    result = run(["-c", CALL, *command.words[1:]], workspace, 110.0)
    assert result.returncode == command.exit_code, result.stderr


def test_every_reason_to_parse_only_is_needed() -> None:
    starts = {c.words[1 : 1 + n] for c in (*ALL_COMMANDS, *HELP_COMMANDS) for n in (1, 2)}
    assert set(PARSED_ONLY) <= starts
    assert set(PRELUDES) | set(NOT_RUN) <= set(WITH_PYTHON)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_make_targets_are_there(document: str) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    named = re.findall(r"(?:^|`|\$ |&& )make ([a-z][a-z-]*)", text_of(document), re.MULTILINE)
    assert set(named) <= targets


@pytest.mark.parametrize("document", DOCUMENTS)
def test_files_that_are_named_are_there(document: str) -> None:
    text = text_of(document)
    below = "dscp_core|dscp_ros|msg_adapters|tests|benchmarks|bags|config|docs|examples|scripts"
    missing = [
        path
        for path in re.findall(rf"`((?:{below})/[\w./*-]+)`", text)
        if not any(ROOT.glob(path.rstrip("/")))
    ]
    folder = (ROOT / document).parent
    missing += [
        target
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
        if not (folder / target).exists()
    ]
    assert not missing


@pytest.mark.parametrize("document", [d for d in DOCUMENTS if d != HISTORY])
def test_modules_that_are_named_are_there(document: str) -> None:
    missing = []
    for name in re.findall(r"`((?:dscp_core|dscp_ros|msg_adapters)(?:\.\w+)+)`", text_of(document)):
        module, rest = name, list[str]()
        while True:
            try:
                found = importlib.import_module(module)
                break
            except ModuleNotFoundError:
                module, _, attribute = module.rpartition(".")
                rest.insert(0, attribute)
        for attribute in rest:
            found = getattr(found, attribute, None)
        if found is None:
            missing.append(name)
    assert not missing


def test_commands_are_found_as_a_shell_finds_them() -> None:
    text = """
.venv/bin/dscp plan a --set x=1 \\
    --json        # a comment
dscp bag recover a b && dscp bag check b; echo $?
dscp plan a --set terminal_time=1       # exit code 3
colcon build
  dscp plan b      (infeasible: exit code 3)
python -m benchmarks start
"""
    found = [(c.place, " ".join(c.words), c.exit_code) for c in commands_of(text, "d", 10)]
    assert found == [
        ("d:11", "dscp plan a --set x=1 --json", 0),
        ("d:13", "dscp bag recover a b", 0),
        ("d:13", "dscp bag check b", 0),
        ("d:14", "dscp plan a --set terminal_time=1", 3),
        ("d:16", "dscp plan b", 3),
        ("d:17", "python -m benchmarks start", 0),
    ]
    shown = list(commands_of("$ dscp plan a\ndscp: error: it's wrong\n", "d", 1))
    assert [c.words for c in shown] == [("dscp", "plan", "a")]
