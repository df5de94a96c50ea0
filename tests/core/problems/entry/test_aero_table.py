"""Aerodynamic tables of entry vehicles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem

ENTRY: OptimalControlProblem = problems.get("entry")
ANGLES, MACHS = (0.0, 0.2, 0.4, 0.7), (5.0, 12.0, 20.0)
LIFT = (2.4, 1.5, -0.03)
DRAG = (0.25, -0.02, 2.3, 0.0006)


def rows() -> list[list[str]]:
    table = []
    for a in ANGLES:
        for m in MACHS:
            lift = a * (LIFT[0] + LIFT[1] * a + LIFT[2] * m)
            drag = DRAG[0] + DRAG[1] * m + DRAG[2] * a**2 + DRAG[3] * m**2
            table.append([repr(value) for value in (a, m, lift, drag)])
    return table


def vehicle(folder: Path, table: list[list[str]], more: str = "", header: str = "") -> Path:
    head = header or "angle_of_attack,mach,lift,drag"
    text = "\n".join([head, *(",".join(row) for row in table)])
    (folder / "aero.csv").write_text(text + "\n")
    path = folder / "vehicle.yaml"
    path.write_text(f"mass: 1000.0\naerodynamic_table: aero.csv\n{more}")
    return path


def test_table_gives_the_coefficients(tmp_path: Path) -> None:
    values = ENTRY.read_vehicle(vehicle(tmp_path, rows()))
    assert values["mass"] == 1000.0
    np.testing.assert_allclose(values["lift_coefficients"], LIFT, rtol=1e-10)
    np.testing.assert_allclose(values["drag_coefficients"], DRAG, rtol=1e-10)
    ENTRY.pack(values)


def test_columns_may_stand_in_any_order(tmp_path: Path) -> None:
    turned = [[row[3], row[1], row[0], row[2]] for row in rows()]
    path = vehicle(tmp_path, turned, header="drag,mach,angle_of_attack,lift")
    np.testing.assert_allclose(ENTRY.read_vehicle(path)["drag_coefficients"], DRAG, rtol=1e-10)


def test_gaps_are_named(tmp_path: Path) -> None:
    without = [row for row in rows() if (row[0], row[1]) != ("0.4", "12.0")]
    with pytest.raises(InvalidInputError, match=r"\(0.4 rad, Mach 12\).*no gap"):
        ENTRY.read_vehicle(vehicle(tmp_path, without))
    for text in ("", "nan", "n/a", "inf"):
        holed = rows()
        holed[5][2] = text
        with pytest.raises(InvalidInputError, match=r"lift in line 7 of .*aero.csv"):
            ENTRY.read_vehicle(vehicle(tmp_path, holed))
    short = rows()
    short[3].pop()
    with pytest.raises(InvalidInputError, match="drag in line 5"):
        ENTRY.read_vehicle(vehicle(tmp_path, short))


def test_pairs_given_twice_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"\(0 rad, Mach 5\).*each once"):
        ENTRY.read_vehicle(vehicle(tmp_path, [*rows(), rows()[0]]))


def test_tables_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="columns of"):
        ENTRY.read_vehicle(vehicle(tmp_path, rows(), header="alpha,mach,lift,drag"))
    with pytest.raises(InvalidInputError, match="rows of"):
        ENTRY.read_vehicle(vehicle(tmp_path, []))
    with pytest.raises(InvalidInputError, match="rank"):
        ENTRY.read_vehicle(vehicle(tmp_path, [row for row in rows() if row[1] == "5.0"]))
    odd = rows()
    odd[-1][3] = "9.0"
    with pytest.raises(InvalidInputError, match=r"drag in .*polynomial"):
        ENTRY.read_vehicle(vehicle(tmp_path, odd))
    with pytest.raises(InvalidInputError, match="lift_coefficients beside it"):
        ENTRY.read_vehicle(vehicle(tmp_path, rows(), "lift_coefficients: [1.0, 1.0, 0.0]\n"))
    path = tmp_path / "vehicle.yaml"
    path.write_text("aerodynamic_table: nowhere.csv\n")
    with pytest.raises(InvalidInputError, match="readable"):
        ENTRY.read_vehicle(path)
    path.write_text("aerodynamic_table: [1.0, 2.0]\n")
    with pytest.raises(InvalidInputError, match="the name of a file"):
        ENTRY.read_vehicle(path)


def test_only_entry_has_tables(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text("aerodynamic_table: aero.csv\n")
    descent = problems.get("powered_descent")
    with pytest.raises(InvalidInputError, match="aerodynamic_table"):
        descent.pack(descent.read_vehicle(path))
