"""`dscp train` and `dscp evaluate`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from learning_support import network

from dscp_core.learning import recipes
from dscp_ros.cli import ExitCode, evaluate_command
from dscp_ros.cli import main as frame


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the default recipe and the evaluated sets small."""
    from learning_support import tiny_recipe

    monkeypatch.setitem(recipes.RECIPES, "default", tiny_recipe())
    monkeypatch.setattr(evaluate_command, "PROFILE_POINTS", 2)
    monkeypatch.setattr(evaluate_command, "LATERAL_POINTS", 3)
    monkeypatch.setattr(evaluate_command, "IPOPT_STATES", 1)


def test_train_then_evaluate(
    small: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "training"
    train = ["train", "terminal-time", "--output", str(output), "--intervals", "20", "--workers"]
    assert frame.main([*train, "1", "--seed", "1", "--json"]) == ExitCode.OK
    summary = json.loads(capsys.readouterr().out)
    assert Path(summary["network"]).is_file()
    assert Path(summary["figure"]).read_bytes().startswith(b"\x89PNG")
    assert 0.0 < summary["validation_p99_relative_error"] < 0.1

    assert frame.main([*train, "1", "--seed", "1"]) == ExitCode.BAD_INPUT
    assert "resume" in capsys.readouterr().err
    assert frame.main([*train, "2", "--seed", "1", "--resume"]) == ExitCode.OK
    assert "relative error on 8 states" in capsys.readouterr().out

    evaluate = ["evaluate", "terminal-time", summary["network"], "--workers", "1"]
    figures = tmp_path / "figures"
    full = [*evaluate, "--samples", "2", "--feasibility-samples", "2"]
    assert frame.main([*full, "--json", "--output", str(figures)]) == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    for name in ("vertical", "horizontal", "box"):
        for key in ("max", "p99", "mean"):
            assert 0.0 < document[name][f"{key}_relative_error"] < 0.1
    assert document["box"]["states"] == 2
    assert document["feasibility"]["states"] == 2
    assert document["ipopt"]["max_relative_difference"] < 1e-3
    assert all(Path(name).is_file() for name in document["files"])
    assert len(document["files"]) == 2
    assert frame.main([*evaluate, "--quick"]) == ExitCode.OK
    text = capsys.readouterr().out
    assert "vertical" in text
    assert "box" not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "terminal-time", "--recipe", "papr"], "default, paper"),
        (["train", "terminal-time", "--epochs", "3"], "epochs"),
        (["train", "terminal-time", "--set", "thrust_mx=3"], "did you mean thrust_m"),
        (["train", "terminal-time", "--seed", "-1"], "seed"),
        (["train", "terminal-time", "--workers", "0"], "workers"),
        (["evaluate", "terminal-time", "--samples", "0"], "--samples"),
        (["evaluate", "terminal-time", "no/such/file"], "no/such/file"),
    ],
)
def test_bad_input(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert frame.main(arguments) == ExitCode.BAD_INPUT
    assert message in capsys.readouterr().err


def test_built_in_network_is_that_good(small: None, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["evaluate", "terminal-time", "--quick", "--json", "--workers", "1"]
    assert frame.main(arguments) == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    for name in ("vertical", "horizontal"):
        # The target on the whole profiles; these are their corners and centers.
        assert document[name]["max_relative_error"] < 1e-4
        assert document[name]["infeasible"] == 0


def test_tampered_network(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "net.safetensors"
    network().save(path)
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(bytes(content))
    assert frame.main(["evaluate", "terminal-time", str(path)]) == ExitCode.BAD_INPUT
    assert "the file was changed" in capsys.readouterr().err


def test_network_of_another_vehicle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "net.safetensors"
    network().save(path)
    assert frame.main(["evaluate", "terminal-time", str(path), "--quick"]) == ExitCode.BAD_INPUT
    assert "which the terminal-time network was trained for" in capsys.readouterr().err


def test_output_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "file"
    path.write_text("")
    for command in ("train", "evaluate"):
        arguments = [command, "terminal-time", "--output", str(path)]
        assert frame.main(arguments) == ExitCode.BAD_INPUT
        assert "a directory" in capsys.readouterr().err
