"""Parameter files, misspelt names, and the table of declared parameters."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import yaml
from adapter_cases import example_plan
from ros.planner_support import ROOT

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import TerminalTime
from dscp_ros.planner.parameter_files import (
    ParameterArguments,
    check_node_names,
    check_parameter_names,
    parameter_arguments,
    read_parameters,
)
from dscp_ros.planner.parameters import (
    PROBLEM,
    formulation_parameters,
    node_settings,
    parameter_table,
)

PROBLEM_NAME = "powered_descent"
FORMULATION = problems.formulations(PROBLEM_NAME)[0]
DECLARED = problems.get(PROBLEM_NAME, FORMULATION)


def files(*paths: Path) -> ParameterArguments:
    return ParameterArguments(tuple(map(str, paths)), frozenset(), ())


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def defaults() -> dict[str, object]:
    return {p.name: p.default for p in parameter_table(DECLARED)}


def test_parameter_arguments_are_found_among_ros_arguments_only():
    arguments = parameter_arguments(
        ["-p", "ignored:=1", "--ros-args", "-p", "deadline_s:=1.0", "--params-file", "a.yaml",
         "--param", "other:intervals:=3", "-r", "__node:=x", "--", "-p", "no:=1", "--ros-args",
         "--params-file", "b.yaml", "-p"]
    )  # fmt: skip
    assert arguments.files == ("a.yaml", "b.yaml")
    assert arguments.names == {"deadline_s", "intervals"}
    assert arguments.nodes == ("other",)


@pytest.mark.parametrize(
    ("section", "node"),
    [
        ("/**", "/planner"),
        ("/**", "/ns/planner"),
        ("planner", "/planner"),
        ("/planner", "/planner"),
        ("/*", "/planner"),
        ("/ns/planner", "/ns/planner"),
        ("/*/planner", "/ns/planner"),
        ("/**/planner", "/a/b/planner"),
    ],
)
def test_sections_that_apply(tmp_path, section, node):
    path = write(tmp_path / "p.yaml", f"{section}: {{ros__parameters: {{deadline_s: 2.0}}}}")
    check_node_names(files(path), node)
    assert read_parameters(files(path), node) == {"deadline_s": 2.0}


@pytest.mark.parametrize(
    ("section", "node"),
    [("planer", "/planner"), ("/ns/planner", "/planner"), ("/*", "/ns/planner"), ("x", "/planner")],
)
def test_a_file_without_a_section_for_the_node_is_refused(tmp_path, section, node):
    path = write(tmp_path / "p.yaml", f"{section}: {{ros__parameters: {{deadline_s: 2.0}}}}")
    with pytest.raises(InvalidInputError, match=node):
        check_node_names(files(path), node)


def test_a_nearly_right_section_beside_a_wildcard_is_refused(tmp_path):
    path = write(
        tmp_path / "p.yaml",
        "/**: {ros__parameters: {intervals: 50}}\nplaner: {ros__parameters: {deadline_s: 2.0}}",
    )
    with pytest.raises(InvalidInputError, match=r"planer.*did you mean /planner"):
        check_node_names(files(path), "/planner")


def test_sections_of_other_nodes_are_theirs(tmp_path):
    path = write(
        tmp_path / "p.yaml",
        "planner_a: {ros__parameters: {intervals: 50}}\n"
        "planner_b: {ros__parameters: {intervals: 60}}\n"
        "camera: {ros__parameters: {rate: 1}}",
    )
    check_node_names(files(path), "/planner_a")
    assert read_parameters(files(path), "/planner_a") == {"intervals": 50}


def test_a_misspelt_node_of_an_override_is_refused():
    arguments = ParameterArguments((), frozenset(), ("plnner",))
    with pytest.raises(InvalidInputError, match="did you mean /planner"):
        check_node_names(arguments, "/planner")


def test_later_files_win_and_the_command_line_wins_over_both(tmp_path):
    first = write(
        tmp_path / "1.yaml", "/**: {ros__parameters: {deadline_s: 1.0, intervals: 20, a: {b: 1}}}"
    )
    second = write(
        tmp_path / "2.yaml", "ns: {planner: {ros__parameters: {deadline_s: 2.0, intervals: 30}}}"
    )
    arguments = ParameterArguments((str(first), str(second)), frozenset({"intervals"}), ())
    assert read_parameters(arguments, "/ns/planner") == {"deadline_s": 2.0, "a.b": 1}


def test_an_exponent_without_a_point_is_a_number_as_for_rcl(tmp_path):
    path = write(tmp_path / "p.yaml", "/**: {ros__parameters: {cost_tolerance: 1e-8, b: 1E+3}}")
    assert read_parameters(files(path), "/planner") == {"cost_tolerance": 1e-8, "b": 1000.0}


@pytest.mark.parametrize(
    "text",
    ["[unclosed", "- a list", "planner: 3", "planner: {ros__parameters: 3}", "\x00"],
)
def test_what_is_no_parameter_file_is_refused(tmp_path, text):
    path = write(tmp_path / "p.yaml", text)
    with pytest.raises(InvalidInputError, match=r"p\.yaml"):
        check_node_names(files(path), "/planner")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InvalidInputError, match=r"missing\.yaml"):
        check_node_names(files(tmp_path / "missing.yaml"), "/planner")


def test_unknown_names_come_with_the_near_ones():
    declared = ["deadline_s", "parameters.thrust_max", "intervals"]
    check_parameter_names(["intervals"], declared)
    with pytest.raises(InvalidInputError) as caught:
        check_parameter_names(["dedline_s", "zzz", "intervals"], declared)
    assert caught.value.value == ["dedline_s", "zzz"]
    assert "dedline_s (did you mean deadline_s?); zzz" in str(caught.value)


def test_every_default_is_within_its_bounds():
    for parameter in (
        PROBLEM,
        *formulation_parameters(problems.formulations(PROBLEM_NAME)),
        *parameter_table(DECLARED),
    ):
        parameter.check(parameter.default)
        assert parameter.descriptor().description


def test_names_are_declared_once():
    names = [p.name for p in parameter_table(DECLARED)]
    assert len(set(names)) == len(names)


def test_what_a_state_sets_is_no_parameter():
    names = {p.name for p in parameter_table(DECLARED)}
    assert not names & {f"parameters.{n}" for n in DECLARED.initial_state_parameters}
    assert "parameters.thrust_max" in names


def test_vectors_are_given_in_the_landing_frame():
    values = defaults() | {"parameters.final_position": [1.0, 2.0, 30.0]}
    settings = node_settings(DECLARED, values)
    assert settings.planner.parameters["final_position"] == [30.0, 1.0, 2.0]
    path, markers = settings.drawing.draw(example_plan(), 0, frame="landing_site")
    apex = next(m for m in markers.markers if m.ns == "glideslope").points[0]
    assert (apex.x, apex.y, apex.z) == (1.0, 2.0, 30.0)
    assert len(path.poses) == len(example_plan().times_s)


def test_terminal_time_source_is_a_setting():
    values = defaults() | {"terminal_time_source": "fixed"}
    settings = node_settings(DECLARED, values)
    assert settings.planner.terminal_time is TerminalTime.FIXED


@pytest.mark.parametrize("solver", ["", "simplex", "qoco,qoco", "qoco,", "qoco clarabel"])
def test_a_solver_that_does_not_exist_is_refused(solver):
    with pytest.raises(InvalidInputError, match="solver"):
        node_settings(DECLARED, defaults() | {"solver": solver})


def test_the_shipped_file_holds_the_defaults():
    content = yaml.safe_load((ROOT / "config" / "powered_descent.yaml").read_text())
    shipped = content["/**"]["ros__parameters"]
    for name, value in shipped.pop("parameters").items():
        shipped[f"parameters.{name}"] = value
    assert shipped.pop("problem") == PROBLEM_NAME
    declared = defaults()
    assert {name: declared.get(name) for name in shipped} == shipped


def test_an_infinite_bound_is_none_where_the_problem_says_so(tmp_path):
    table = {p.name: p for p in parameter_table(problems.get("powered_descent"))}
    rate = table["parameters.thrust_rate_max"]
    assert rate.default == math.inf
    assert not rate.descriptor().floating_point_range  # has no room for it
    path = write(tmp_path / "p.yaml", "/**: {ros__parameters: {rate: .inf}}")
    rate.check(read_parameters(files(path), "/planner")["rate"])
    with pytest.raises(InvalidInputError, match="got nan, expected no NaN"):
        rate.check(math.nan)
    with pytest.raises(InvalidInputError, match=r"got 0.5, expected \[1, inf\] N/s"):
        rate.check(0.5)
    with pytest.raises(InvalidInputError, match="got inf, expected finite"):
        table["parameters.thrust_max"].check(math.inf)
