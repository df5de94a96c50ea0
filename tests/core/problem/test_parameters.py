from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.problem.parameters import Parameter, ParameterTable, load_parameter_file

THRUST = Parameter("thrust_max", 8.0e5, "N", "Greatest thrust.", lower=1.0, upper=1e9)
START = Parameter("initial_position", (5.0, 6.0, 7.0), "m", "Start.", lower=-10.0, upper=10.0)


@pytest.fixture
def table() -> ParameterTable:
    return ParameterTable((THRUST, START))


def test_sizes_follow_the_default() -> None:
    assert (THRUST.size, THRUST.is_vector) == (1, False)
    assert (START.size, START.is_vector) == (3, True)
    one = Parameter("one", (1.0,), "1", "A vector with one component.")
    assert (one.size, one.is_vector) == (1, True)


@pytest.mark.parametrize("value", [3.0, 3, [3.0], np.array([3.0]), np.float32(3.0)])
def test_scalar_takes_numbers(value: object) -> None:
    np.testing.assert_array_equal(THRUST.validate(value), [3.0])


def test_validated_value_is_a_copy() -> None:
    given_value = np.array([1.0, 2.0, 3.0])
    checked = START.validate(given_value)
    checked[0] = 9.0
    assert given_value[0] == 1.0


@pytest.mark.parametrize(
    ("parameter", "value", "bound"),
    [
        (THRUST, "fast", "a number or a list of numbers"),
        (THRUST, {"a": 1}, "a number or a list of numbers"),
        (THRUST, [1.0, 2.0], "length 1"),
        (THRUST, [], "length 1"),
        (START, 1.0, "length 3"),
        (START, [1.0, 2.0], "length 3"),
        (START, [[1.0, 2.0, 3.0]], "length 3"),
        (START, [1.0, [2.0], 3.0], "a number or a list of numbers"),
        (THRUST, math.nan, "finite"),
        (THRUST, math.inf, "finite"),
        (START, [1.0, -math.inf, 2.0], "finite"),
        (THRUST, None, "a number or a list of numbers"),
        (THRUST, "32.5", "a number or a list of numbers"),
        (THRUST, 0.5, "[1, 1e+09] N"),
        (THRUST, 2e9, "[1, 1e+09] N"),
        (START, [0.0, 10.1, 0.0], "[-10, 10] m"),
    ],
)
def test_bad_values_name_field_value_and_bound(
    parameter: Parameter, value: object, bound: str
) -> None:
    with pytest.raises(InvalidInputError) as caught:
        parameter.validate(value)
    assert caught.value.field == parameter.name
    assert caught.value.value is value
    assert bound in caught.value.bound
    assert parameter.name in str(caught.value)
    assert isinstance(caught.value, DscpError)


def test_bounds_are_admissible() -> None:
    np.testing.assert_array_equal(THRUST.validate(1.0), [1.0])
    np.testing.assert_array_equal(START.validate([-10.0, 10.0, 0.0]), [-10.0, 10.0, 0.0])


def test_pack_defaults_and_overrides(table: ParameterTable) -> None:
    assert table.size == 4
    assert table.names == ("thrust_max", "initial_position")
    np.testing.assert_array_equal(table.pack(), [8.0e5, 5.0, 6.0, 7.0])
    packed = table.pack({"initial_position": (1.0, 2.0, 3.0)})
    np.testing.assert_array_equal(packed, [8.0e5, 1.0, 2.0, 3.0])
    assert table.slice("initial_position") == slice(1, 4)


def test_pack_on_a_base_leaves_the_base_alone(table: ParameterTable) -> None:
    base = table.pack({"thrust_max": 7.0})
    packed = table.pack({"initial_position": [0.0, 0.0, 1.0]}, base=base)
    np.testing.assert_array_equal(packed, [7.0, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(base, [7.0, 5.0, 6.0, 7.0])


@given(thrust=st.floats(1.0, 1e9), start=st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3))
def test_unpack_is_the_inverse_of_pack(thrust: float, start: list[float]) -> None:
    table = ParameterTable((THRUST, START))
    values = table.unpack(table.pack({"thrust_max": thrust, "initial_position": start}))
    assert values["thrust_max"] == thrust
    assert isinstance(values["thrust_max"], float)
    np.testing.assert_array_equal(values["initial_position"], start)


def test_unknown_name_lists_near_ones(table: ParameterTable) -> None:
    with pytest.raises(InvalidInputError, match="did you mean thrust_max"):
        table.pack({"thrust_mx": 1.0})
    with pytest.raises(InvalidInputError, match="thrust_max, initial_position"):
        table.slice("q")


def test_names_are_unique() -> None:
    with pytest.raises(InvalidInputError, match="thrust_max"):
        ParameterTable((THRUST, START, THRUST))


def test_other_defaults(table: ParameterTable) -> None:
    other = table.with_defaults({"initial_position": [1.0, 1.0, 1.0]})
    np.testing.assert_array_equal(other.pack(), [8.0e5, 1.0, 1.0, 1.0])
    assert other["initial_position"].source == "file"
    np.testing.assert_array_equal(table.pack(), [8.0e5, 5.0, 6.0, 7.0])
    with pytest.raises(InvalidInputError, match="thrust_max"):
        table.with_defaults({"thrust_max": -1.0})
    with pytest.raises(InvalidInputError, match="thrust_mox"):
        table.with_defaults({"thrust_mox": 1.0})


def test_parameter_file(tmp_path: Path, table: ParameterTable) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text("thrust_max: 9.0e+5\ninitial_position: [1, 2, 3]\n", encoding="utf-8")
    np.testing.assert_array_equal(table.pack(load_parameter_file(path)), [9.0e5, 1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("content", "bound"),
    [
        (None, "a readable file"),
        (b"thrust: [1, 2", "valid YAML"),
        (b"- 1\n- 2\n", "a mapping of names"),
        (b"", "a mapping of names"),
        (b"1: 2\n", "a mapping of names"),
        (b"\xff\xfe\xfa", "a readable file"),
        (b"thrust_max: 1\nthrust_max: 2\n", "thrust_max is given twice"),
        (b"thrust_max: 2026-13-45\n", "valid YAML"),
        (b"thrust_max: " + b"9" * 5000, "valid YAML"),
        (b"thrust_max: " + b"[" * 3000 + b"]" * 3000, "valid YAML"),
    ],
    ids=[
        "missing",
        "no YAML",
        "list",
        "empty",
        "number as name",
        "no text",
        "twice",
        "no date",
        "too many digits",
        "too deep",
    ],
)
def test_bad_parameter_file(tmp_path: Path, content: bytes | None, bound: str) -> None:
    path = tmp_path / "vehicle.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InvalidInputError) as caught:
        load_parameter_file(path)
    assert caught.value.field == "parameter file"
    assert str(path) in str(caught.value)
    assert bound in caught.value.bound


@pytest.mark.parametrize(
    ("written", "meant"),
    [("8.4e5", 8.4e5), ("8e5", 8e5), ("84", 84.0), ("+84.", 84.0), ("010", 10.0), (".5e3", 500.0)],
)
def test_numbers_in_files_are_what_they_look_like(
    tmp_path: Path, table: ParameterTable, written: str, meant: float
) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(f"thrust_max: {written}\n", encoding="utf-8")
    assert table.pack(load_parameter_file(path))[0] == meant


@pytest.mark.parametrize("written", ["1:30", "1_000", "0x10", "1e", "--1", "'84'"])
def test_what_only_may_be_a_number_is_refused(
    tmp_path: Path, table: ParameterTable, written: str
) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(f"thrust_max: {written}\n", encoding="utf-8")
    with pytest.raises(InvalidInputError, match="thrust_max"):
        table.pack(load_parameter_file(path))


def test_directory_is_no_parameter_file(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="a readable file"):
        load_parameter_file(tmp_path)
