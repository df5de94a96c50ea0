"""docs/own-problem.md, from its blank file to the node: what it shows is what comes out."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from documentation_support import blocks, commands, python_blocks, text_of
from ros.any_problem_support import running, write_log

from dscp_core import Method, OptimalControlProblem, Planner, problems
from dscp_core.planning.plan import PlanStatus
from dscp_ros.parameter_set import load
from dscp_ros.planner.choice import ProblemChoice
from msg_adapters.errors import InputCode

DOCUMENT = "docs/own-problem.md"
CALL = "import sys; from dscp_ros.cli.main import main; sys.exit(main())"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory of the reader, with the file that the page lets write."""
    after = text_of(DOCUMENT)[: text_of(DOCUMENT).index("## Plan, and look")].count("\n") + 1
    written = [block.text for block in python_blocks(DOCUMENT) if block.line < after]
    written += [block.text for block in python_blocks(DOCUMENT) if "def price" in block.text]
    (tmp_path / "my_inspector.py").write_text("\n\n".join(written))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shown(start: str) -> list[str]:
    """The first command of the page that begins so, as words after `dscp`."""
    return list(
        next(c.words for c in commands(DOCUMENT) if " ".join(c.words).startswith(start))[1:]
    )


def node_arguments(folder: Path, having: str = "") -> list[str]:
    """Arguments of a command of the page that starts the node, from another working directory."""
    words = next(
        c.words
        for c in commands(DOCUMENT)
        if c.words[1] == "planner" and having in " ".join(c.words)
    )
    return [str(folder / word) if "/" in word or ".py:" in word else word for word in words[2:]]


def dscp(words: list[str]) -> str:
    done = subprocess.run(
        [sys.executable, "-c", CALL, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_names_every_field_of_a_declaration() -> None:
    table = text_of(DOCUMENT).partition("## Fields of a declaration")[2]
    named = [field.name for field in fields(OptimalControlProblem) if field.init]
    prefixes = ("virtual_control", "trust_region")
    missing = [
        name
        for name in named
        if f"`{name}`" not in table
        and not any(name.startswith(p) and f"`{name.removeprefix(p)}`" in table for p in prefixes)
    ]
    assert not missing


@pytest.mark.slow
def test_its_plan_and_its_gradient_are_those_that_it_shows(folder: Path) -> None:
    (text,) = (block.text for block in blocks(DOCUMENT) if block.language == "text")
    outcome = Planner(problems.get("my_inspector.py:inspector")).plan()
    lines = [outcome.headline]
    lines += [
        f"{c.name:14} {c.worst_value:10.3g} <= {c.bound:g} {c.unit}"
        for c in outcome.certificate.checks
    ]
    # What there is to gain depends on the solver's rounding; the rest does not.
    cost, _, gain = text.splitlines()[0].rpartition(", at most ")
    assert lines[0].startswith(f"{cost}, at most ")
    assert float(gain.split()[0]) < 1e-3
    assert lines[1:4] == text.splitlines()[1:4]
    # Of an active constraint there is rounding left.
    assert lines[4].split()[0] == text.splitlines()[4].split()[0]

    dscp(shown("dscp plan my_inspector.py:inspector --plot"))
    assert (folder / "inspector.png").stat().st_size > 20_000
    assert json.loads(dscp(shown("dscp plan my_inspector.py:inspector --set")))["certified"]
    assert "acceleration_max" in dscp(["plan", "my_inspector.py:inspector", "--list-parameters"])
    report = json.loads(dscp([*shown("dscp gradient"), "--json"]))
    assert report["trusted"]
    assert all(abs(error) < 1e-6 for error in report["relative_error"].values())


def test_its_virtual_control_is_what_it_says(folder: Path) -> None:
    problem = problems.get("my_inspector.py:inspector")
    without = Planner(replace(problem, virtual_control_scale=())).plan()
    assert without.status is PlanStatus.INFEASIBLE
    assert "iteration 1" in without.message
    for weight, trusted in ((1.0, True), (10.0, False)):
        planner = Planner(problem, parameters={"virtual_control_weight": weight})
        assert planner.plan().certified
        assert planner.gradient("cost", method=Method.UNROLLED).trusted is trusted


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_its_node_plans_and_its_log_tunes(ros, folder: Path) -> None:
    name = "my_inspector.py:inspector"
    problem = problems.get(name)
    (sender,) = (block.text for block in python_blocks(DOCUMENT) if "JointState(" in block.text)
    (values,) = (x for x in sender.splitlines() if x.startswith("message.position"))
    state = np.array(json.loads(values.partition("= ")[2]))
    (names,) = (x for x in sender.splitlines() if x.startswith("message = "))
    assert names.endswith(f"JointState(name={json.dumps([s.name for s in problem.states])})")

    with running(ros, problem, before=node_arguments(folder)) as (client, _):
        report = client.report(state)
        assert report.code == PlanStatus.CERTIFIED, report.message
        assert list(client.trajectories[-1].joint_names) == [
            v.name for v in (*problem.states, *problem.controls)
        ]
        assert client.trajectories[-1].header.frame_id == "world"
        beyond = client.report(np.array([2e4, *state[1:]]))
        assert beyond.code == InputCode.OUT_OF_RANGE

    random = np.random.default_rng(0)
    spread = np.array([20.0, 30.0, 20.0, 0.1, 0.1, 0.1])
    write_log(
        folder / "flight", name, [state + spread * random.uniform(-1, 1, 6) for _ in range(10)]
    )
    words = shown("dscp tune")
    report = json.loads(dscp([*words, "--json"]))
    before, after = (report["held_out"][when] for when in ("before", "after"))
    assert after["loss"] < before["loss"]
    assert after["failures"] == 0
    found = load("sets/inspector", ProblemChoice.read(name))
    seconds = found.values["parameters.terminal_time"]
    # Between the bounds, where the price of all states is least.
    planner = {t: Planner(problem, parameters={"terminal_time": t}) for t in (600.0, seconds)}
    assert 650.0 < seconds < 1200.0
    assert all(p.plan(state).certified for p in planner.values())
    with running(ros, problem, before=node_arguments(folder, "--params-file")) as (client, _):
        report = client.report(state)
        assert report.code == PlanStatus.CERTIFIED, report.message
        assert report.attempt.terminal_time_used_s == pytest.approx(seconds)
