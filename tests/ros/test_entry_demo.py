"""The demonstration of entry end to end, with short bags, in real processes."""

from __future__ import annotations

import math
from pathlib import Path

from ros.test_demo import PNG_SIGNATURE, REPORT, TRAJECTORY, excerpt, recorded, running, values_of

from dscp_ros.cli import ExitCode

BAGS = Path(__file__).resolve().parents[2] / "bags"


def test_an_entry_is_flown_and_drawn(tmp_path: Path) -> None:
    # A story of 100 s; then four states a minute apart, the last one bad.
    bag = excerpt(BAGS / "entry_dispersed", tmp_path / "in_dispersed", 100.0 + 181.0)
    with running(tmp_path / "out", "--problem", "entry", "--bag", bag) as demo:
        assert demo.finish() == ExitCode.OK, demo.text
        assert demo.processes() == []
    messages = recorded(tmp_path / "out")
    reports = [values_of(report) for report in messages[REPORT]]
    assert {"101", "0"} == {report["code"] for report in reports}, demo.text
    certified = [report for report in reports if report["code"] == "0"]
    assert len(certified) == len(messages[TRAJECTORY]) > 1
    assert all("state.bank_angle" in report for report in certified)
    for trajectory in messages[TRAJECTORY]:
        assert trajectory.header.frame_id == "earth"
        end = dict(zip(trajectory.joint_names, trajectory.points[-1].positions, strict=True))
        assert math.isclose(math.degrees(end["longitude"]), 120.0, abs_tol=1e-3)
    assert "km from the planet's centre" in demo.text
    picture = (tmp_path / "out" / "entry.png").read_bytes()
    assert picture.startswith(PNG_SIGNATURE)
    assert len(picture) > 20_000  # an empty figure of this size takes 5 kB
