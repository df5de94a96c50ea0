"""`dscp gradient`: derivatives of a plan without ROS."""

from __future__ import annotations

import json
from typing import Any

import pytest

from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main

# What the differences of whole runs resolve: runs repeat to 1e-15 of the mass, 3e-11 kg, over
# steps of 1e-3 s and gradients of 10 kg/s.
ERROR = 1e-6


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


@pytest.fixture
def gradient(capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs `dscp gradient powered_descent ... --json`; returns exit code and parsed answer."""

    def run(*arguments: str) -> tuple[int, dict[str, Any]]:
        code = main(["gradient", "powered_descent", *arguments, "--json"])
        return code, json.loads(capsys.readouterr().out, parse_constant=refuse)

    return run


@pytest.mark.parametrize(("time_s", "sign"), [(32.5, 1.0), (33.2, -1.0)])
def test_final_mass_over_terminal_time(gradient: Any, time_s: float, sign: float) -> None:
    code, answer = gradient(
        *("--of", "final_mass", "--wrt", "terminal_time", "--check"),
        *("--set", f"terminal_time={time_s}"),
    )
    assert code == ExitCode.OK
    assert answer["trusted"] is True
    assert (answer["feasible"], answer["converged"]) == (True, True)
    assert f"terminal time fixed at {time_s} s; run feasible, converged" in answer["headline"]
    assert answer["reasons"] == []
    assert answer["method"] == "unrolled"
    # More time saves fuel before the optimum at 32.81 s and costs fuel after it.
    assert sign * answer["gradient"] > 1.0
    assert answer["central_difference"] == pytest.approx(answer["gradient"], rel=ERROR)
    assert answer["relative_error"] < ERROR
    assert answer["check"]["kind"] == "central"


def test_vector_parameter_component_by_component(gradient: Any) -> None:
    code, answer = gradient("--of", "final_mass", "--wrt", "initial_velocity", "--check")
    assert code == ExitCode.OK
    assert len(answer["gradient"]) == len(answer["central_difference"]) == 3
    assert all(error < ERROR for error in answer["relative_error"])
    # Falling faster leaves less to brake against gravity; sideways speed (30, -30) m/s has to go.
    up, y, z = answer["gradient"]
    assert y < 0.0 < z
    assert up == pytest.approx(answer["central_difference"][0], rel=ERROR)


def test_the_final_value_of_any_state(gradient: Any) -> None:
    case = ("--wrt", "initial_mass", "--iterations", "5")
    _, by_state = gradient("--of", "mass", *case)
    _, by_final = gradient("--of", "final_mass", *case)
    assert by_state == by_final
    assert (by_state["of"], by_state["unit"]) == ("final_mass", "kg")
    code, pinned = gradient("--of", "x", *case)
    assert code == ExitCode.OK
    assert pinned["gradient"] == pytest.approx(0.0, abs=1e-9)


def test_several_parameters_by_name_and_a_zero_gradient(gradient: Any) -> None:
    names = ["initial_mass", "glideslope_angle_max"]
    code, answer = gradient("--of", "final_mass", "--wrt", *names, "--check")
    assert code == ExitCode.OK
    assert set(answer["gradient"]) == set(answer["relative_error"]) == set(names)
    assert answer["relative_error"]["initial_mass"] < ERROR
    # The glideslope is never active in this case.
    assert answer["gradient"]["glideslope_angle_max"] == 0.0
    assert answer["relative_error"]["glideslope_angle_max"] is None
    assert any("glideslope_angle_max: zero within" in note for note in answer["notes"])


def test_cost_is_minus_the_final_mass(gradient: Any) -> None:
    _, mass = gradient("--of", "final_mass", "--wrt", "specific_impulse", "thrust_max")
    _, cost = gradient("--of", "cost", "--wrt", "specific_impulse", "thrust_max")
    assert cost["value"] == pytest.approx(-mass["value"])
    for name, value in mass["gradient"].items():
        assert value > 0.0, "a better engine saves fuel"
        assert cost["gradient"][name] == pytest.approx(-value, rel=1e-9)


def test_implicit_and_unrolled_agree_where_the_iterations_have_settled(gradient: Any) -> None:
    case = ("--of", "final_mass", "--wrt", "terminal_time", "--set", "terminal_time=32.5")
    _, unrolled = gradient(*case, "--iterations", "20")
    code, implicit = gradient(*case, "--method", "implicit")
    assert code == ExitCode.OK
    assert implicit["trusted"] is True
    # 20 iterations leave 1e-10; the limit allows for another platform's rounding.
    assert implicit["gradient"] == pytest.approx(unrolled["gradient"], rel=1e-7)


def test_weight_at_its_lower_bound_is_checked_from_one_side(gradient: Any) -> None:
    code, answer = gradient(
        *("--of", "convergence", "--wrt", "trust_region_step", "trust_region_control", "--check"),
        *("--iterations", "3", "--intervals", "20"),
    )
    assert code == ExitCode.OK
    assert "convergence not tested" in answer["headline"]
    assert answer["check"]["trust_region_step"]["kind"] == "forward"
    assert answer["gradient"]["trust_region_step"] == 0.0  # the terminal time is fixed
    largest = max(map(abs, answer["gradient"]["trust_region_control"]))
    for component, check in enumerate(answer["check"]["trust_region_control"]):
        assert check["kind"] == "forward"
        gap = (
            answer["gradient"]["trust_region_control"][component]
            - answer["central_difference"]["trust_region_control"][component]
        )
        # The uncertainty is the disagreement of two extrapolations, not a bound; the noise of
        # the runs (1e-11 kg over a step of 1e-3) stands beside it.
        assert abs(gap) <= max(10.0 * check["uncertainty"], 1e-7 * largest)


def test_step_is_shortened_to_stay_within_the_active_set(gradient: Any) -> None:
    code, answer = gradient(
        "--of", "final_mass", "--wrt", "terminal_time", "--check", "--step", "9"
    )
    assert code == ExitCode.OK
    assert answer["check"]["step"] <= answer["check"]["active_set_radius"]
    assert answer["check"]["crosses_active_set_change"] is False
    assert answer["check"]["step"] < 0.1


def test_infeasible_case_is_not_trusted(gradient: Any) -> None:
    case = ("--of", "final_mass", "--wrt", "terminal_time", "--set", "terminal_time=31")
    for method in ("unrolled", "implicit"):
        code, answer = gradient(*case, "--method", method)
        assert code == ExitCode.NO_PLAN
        assert answer["status"] == "infeasible"
        assert answer["trusted"] is False
        assert (answer["feasible"], answer["converged"]) == (False, False)
        assert "NOT FEASIBLE, NOT CONVERGED: NOT TRUSTED" in answer["headline"]
        assert any("no feasible trajectory" in reason for reason in answer["reasons"])


def test_run_without_a_result_has_no_gradient(gradient: Any) -> None:
    code, answer = gradient(
        "--of", "final_mass", "--wrt", "gravity", "--check", "--set", "terminal_time=1"
    )
    assert code == ExitCode.NO_PLAN
    assert answer["gradient"] is None
    assert answer["trusted"] is False
    assert "iteration 1" in answer["reasons"][0]
    assert answer["headline"].startswith("NO GRADIENT of final_mass: ")


def test_unconverged_run_says_so(gradient: Any) -> None:
    heavy = "trust_region_control=1,1,1"  # steps so short that 20 iterations do not get there
    code, answer = gradient("--of", "final_mass", "--wrt", "terminal_time", "--set", heavy)
    assert code == ExitCode.OK
    assert answer["status"] == "iteration_limit"
    assert answer["trusted"] is False
    assert "NOT CONVERGED: NOT TRUSTED" in answer["headline"]
    assert any("not converged" in reason for reason in answer["reasons"])


MASS = ["--of", "final_mass"]


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["--of", "final_mass"], "--wrt"),
        (["--wrt", "gravity"], "--of"),
        (["--of", "fuel", "--wrt", "gravity"], "--of"),
        ([*MASS, "--wrt", "gravitation"], "parameter"),
        ([*MASS, "--wrt", "gravity", "--iterations", "0"], "--iterations"),
        ([*MASS, "--wrt", "gravity", "--check", "--step", "0"], "--step"),
        ([*MASS, "--wrt", "gravity", "--check", "--step", "nan"], "--step"),
        ([*MASS, "--wrt", "gravity", "--step", "1"], "--step"),
        ([*MASS, "--wrt", "gravity", "--set", "gravity=nan"], "gravity"),
        (["--of", "convergence", "--wrt", "gravity", "--method", "implicit"], "loss"),
    ],
)
def test_bad_input_names_the_field(gradient: Any, arguments: list[str], field: str) -> None:
    code, answer = gradient(*arguments)
    assert code == ExitCode.BAD_INPUT
    assert answer["error"]["field"] == field


def test_text_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    case = ["--wrt", "initial_position", "--intervals", "20", "--check"]
    assert main(["gradient", "powered_descent", "--of", "final_mass", *case]) == ExitCode.OK
    text = capsys.readouterr().out
    assert text.splitlines()[0].startswith("gradient of final_mass, mass(t_f) [kg]; unrolled, ")
    assert text.splitlines()[0].endswith("run feasible, converged: trusted")
    assert "mass(t_f) = 317" in text
    for component in range(3):
        assert f"initial_position[{component}]" in text
    assert "kg per m" in text
    assert "central difference" in text

    assert main(["gradient", "powered_descent", "--list-parameters"]) == ExitCode.OK
    assert "thrust_max" in capsys.readouterr().out
