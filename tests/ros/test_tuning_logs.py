"""States and reports out of logs, through the node's own checks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from dscp_core import problems
from dscp_core.errors import DscpError, InvalidInputError
from dscp_ros.bag import BagWriter, Qos
from dscp_ros.planner.input_checks import InputSettings
from dscp_ros.tuning.logs import LogContent, read_log, topics_of_node
from dscp_ros.tuning.sources import check_new, code_version, file_digests
from dscp_ros.tuning.split import split_by_share, split_given, thin
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import problem_layout
from msg_adapters.report import AttemptFigures, NodeCode, PlanReport
from msg_adapters.report_message import message_from_report
from msg_adapters.stamps import stamp_from_nanoseconds
from msg_adapters.state import StampedState

ROOT = Path(__file__).resolve().parents[2]
BAGS = ROOT / "bags"
LAYOUT = problem_layout(problems.get("powered_descent"))
TOPICS = topics_of_node("/planner", {}, LAYOUT)
STATE = np.array([5000.0, 500.0, 500.0, -150.0, 30.0, -30.0, 38000.0])
SECOND = 10**9
START = 1_700_000_000 * SECOND

Entry = tuple[str, object, int]


def read(path: Path, settings: InputSettings | None = None) -> LogContent:
    return read_log(path, LAYOUT, settings or InputSettings(), TOPICS)


def write(path: Path, entries: Sequence[Entry], **options: int) -> Path:
    """Bag of (topic, message, log time)."""
    with BagWriter(path, **options) as bag:
        for topic, kind in {topic: type(message) for topic, message, _ in entries}.items():
            bag.add_topic(topic, kind, Qos())
        for topic, message, time_ns in entries:
            bag.write(topic, message, time_ns)
    return path


def vehicle_state(stamp_ns: int, log_ns: int | None = None, altitude_m: float = 5000.0) -> Entry:
    values = STATE.copy()
    values[0] = altitude_m
    message = joint_state_from_state(StampedState(stamp_ns, values), LAYOUT)
    return "/planner/vehicle_state", message, stamp_ns if log_ns is None else log_ns


def report(
    stamp_ns: int,
    log_ns: int,
    *,
    of: int | None = None,
    altitude_m: float = 5000.0,
    code: int = 0,
    problem: str = "powered_descent",
    state: bool = True,
) -> Entry:
    values = STATE.copy()
    values[0] = altitude_m
    named = dict(zip(LAYOUT.message_names, LAYOUT.to_message_order(values).tolist(), strict=True))
    attempt = AttemptFigures(
        iterations=4,
        solve_time_ms=50.0,
        solver_time_ms=None,
        deadline_ms=None,
        virtual_control=None,
        max_defect=None,
        cost=None,
        terminal_time_predicted_s=None,
        terminal_time_used_s=32.5,
        warm_started=False,
    )
    content = PlanReport(
        stamp_ns=stamp_ns,
        source="vehicle_state",
        code=code,
        code_name={0: "CERTIFIED", 2: "INFEASIBLE"}.get(code, "EVENT"),
        message="",
        problem=problem,
        input_stamp_ns=of,
        parameter_set="one@0123456789ab" if code == 0 else None,
        state=named if state else {},
        attempt=None if of is None else attempt,
    )
    return "/planner/report", message_from_report(content, node="planner", frame="f"), log_ns


def altitudes(log: LogContent) -> list[float]:
    return [state.values[0] for state in log.states]


def test_dispersed_bag_as_its_readme_says() -> None:
    log = read(BAGS / "powered_descent_dispersed")
    expected = (
        "NOT_FINITE EMPTY_FRAME WRONG_FRAME WRONG_ARRAY_LENGTH MASS_NOT_POSITIVE BELOW_GROUND "
        "STALE_STAMP FUTURE_STAMP STAMP_BACKWARD"
    )
    assert log.refused == dict.fromkeys(expected.split(), 1)
    assert len(log.states) == 40 - 9
    assert log.damage == ()
    assert log.end_ns > log.start_ns > 0
    assert np.allclose(log.states[0].values[6], 38000.0)
    assert all(4900 < state.values[0] < 5500 for state in log.states[:-1])


def test_odometry_is_completed_by_mass() -> None:
    log = read(BAGS / "powered_descent_nominal")
    assert len(log.states) == 348
    assert not log.refused
    masses = [state.values[6] for state in log.states]
    assert 37_000 < masses[0] < 39_000
    assert 31_000 < masses[-1] < 32_000


def test_reports_tell_of_states_and_outcomes(tmp_path: Path) -> None:
    entries = [
        report(START, START, of=START),  # as a recorder may hear it
        vehicle_state(START, altitude_m=5000.0),
        report(START + SECOND, START + SECOND, of=START),
        report(START + 2 * SECOND, START + 2 * SECOND, of=START + 5, altitude_m=5100.0, code=2),
        report(START + 3 * SECOND, START + 3 * SECOND, of=START + 5, altitude_m=5100.0),
        report(START + 3 * SECOND, START + 3 * SECOND + 1, of=START + 6, problem="entry"),
        report(START + 3 * SECOND, START + 3 * SECOND + 2, of=START + 7, state=False),
        report(START + 3 * SECOND, START + 3 * SECOND + 3, code=NodeCode.INTERNAL_ERROR),
    ]
    log = read(write(tmp_path / "bag", entries))
    assert altitudes(log) == [5000.0, 5100.0]
    assert [state.terminal_time_s for state in log.states] == [32.5, 32.5]
    assert log.refused == {"OTHER_PROBLEM": 1, "REPORT_MISSING_KEY": 1}
    figures = log.reports.document()
    assert figures["codes"] == {"CERTIFIED": 4, "INFEASIBLE": 1, "EVENT": 1}
    assert figures["parameter_sets"] == {"one@0123456789ab": 4, "unknown": 1}
    assert (figures["attempts"], figures["certified"]) == (5, 4)
    assert (figures["mean_iterations"], figures["mean_solve_time_ms"]) == (4.0, 50.0)


def test_ages_follow_the_clock_that_the_node_had(tmp_path: Path) -> None:
    """A simulation from START, recorded years later by a recorder with the system's clock."""
    late = START + 10**17
    states = [vehicle_state(START + k * SECOND, late + k * SECOND) for k in range(3)]
    stale = vehicle_state(START + 2 * SECOND + 1, late + 10 * SECOND)
    clocks: list[Entry] = [
        ("/clock", Clock(clock=stamp_from_nanoseconds(START + k * SECOND)), late + k * SECOND)
        for k in range(11)
    ]
    reports = [
        report(START + k * SECOND, late + k * SECOND, code=NodeCode.SUPERSEDED) for k in range(11)
    ]
    with_clock = read(write(tmp_path / "clock", [*clocks, *states, stale]))
    assert len(with_clock.states) == 3
    assert with_clock.refused == {"STALE_STAMP": 1}
    with_reports = read(write(tmp_path / "reports", [*reports, *states, stale]))
    assert len(with_reports.states) == 3
    assert with_reports.refused == {"STALE_STAMP": 1}
    without = read(write(tmp_path / "without", states))
    assert without.refused == {"STALE_STAMP": 3}
    with pytest.raises(InvalidInputError, match="refused: STALE_STAMP 3"):
        without.require_states()


def test_a_clock_that_jumps_back_starts_anew(tmp_path: Path) -> None:
    """A bag that was replayed twice."""
    entries: list[Entry] = []
    for turn in range(2):
        for k in range(3):
            log_ns = START + (10 * turn + k) * SECOND
            clock = Clock(clock=stamp_from_nanoseconds(START + k * SECOND))
            entries.append(("/clock", clock, log_ns))
            entries.append(vehicle_state(START + k * SECOND, log_ns + 1, 5000.0 + turn))
    log = read(write(tmp_path / "bag", entries))
    assert altitudes(log) == [5000.0] * 3 + [5001.0] * 3
    assert not log.refused


def test_other_names_of_node_and_topics(tmp_path: Path) -> None:
    entries = [vehicle_state(START)]
    entries = [("/nav/state", entries[0][1], entries[0][2])]
    path = write(tmp_path / "bag", entries)
    with pytest.raises(InvalidInputError, match=r"/planner/vehicle_state.*it has: /nav/state"):
        read(path)
    topics = topics_of_node("/lander/", {"vehicle_state": "/nav/state"}, LAYOUT)
    assert topics["mass"] == "/lander/mass"
    assert len(read_log(path, LAYOUT, InputSettings(), topics).states) == 1
    with pytest.raises(InvalidInputError, match="one of state, vehicle_state"):
        topics_of_node("/planner", {"path": "/x"}, LAYOUT)


def test_a_topic_of_another_type(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", [("/planner/state", String(data="x"), START)])
    with pytest.raises(InvalidInputError, match="nav_msgs/msg/Odometry"):
        read(path)


def test_logs_without_states(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for name in ("empty.mcap", "empty", "none"):
        with pytest.raises(DscpError, match=name):
            read(tmp_path / name)
    with BagWriter(tmp_path / "silent") as bag:
        bag.add_topic("/planner/state", Odometry, Qos())
    with pytest.raises(InvalidInputError, match="with messages on /planner/state"):
        read(tmp_path / "silent")
    masses = write(tmp_path / "masses", [("/planner/mass", InertiaStamped(), START)])
    with pytest.raises(InvalidInputError, match="it has: /planner/mass"):
        read(masses)


def test_messages_that_cannot_be_decoded(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for topic, kind in (
            ("/planner/vehicle_state", JointState),
            ("/planner/report", DiagnosticArray),
        ):
            bag.add_topic(topic, kind, Qos())
            bag.write_raw(topic, b"\x00\x01\x00\x00\x07", START, START, 0)
        bag.write(*vehicle_state(START + SECOND))
    log = read(tmp_path / "bag")
    assert len(log.states) == 1
    assert log.refused == {"UNDECODABLE": 2}


def test_a_log_cut_in_the_middle_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    entries = [vehicle_state(START + k * SECOND) for k in range(200)]
    whole = write(tmp_path / "whole.mcap", entries, chunk_bytes=2000)
    content = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: len(content) // 2])
    log = read(cut)
    assert 20 < len(log.states) < 180
    assert len(log.damage) >= 1
    assert "truncated" in log.damage[0]
    log.require_states()
    cut.write_bytes(content[:100])
    with pytest.raises(DscpError, match=r"cut\.mcap"):
        read(cut).require_states()


def log_of(count: int, name: str = "log") -> LogContent:
    from dscp_ros.tuning.logs import LoggedState

    states = [LoggedState(START + k * SECOND, START + k * SECOND, STATE) for k in range(count)]
    return LogContent(Path(name), START, START + count * SECOND, states=states)


def test_whole_logs_are_held_out() -> None:
    logs = [log_of(10, str(number)) for number in range(5)]
    split = split_by_share(logs, 0.4, seed=3)
    assert split == split_by_share(logs, 0.4, seed=3)
    assert [bool(part.training) != bool(part.held_out) for part in split.logs] == [True] * 5
    assert sum(bool(part.held_out) for part in split.logs) == 2
    assert "2 of 5 logs" in split.rule
    one = split_by_share(logs[:2], 0.01, seed=0)
    assert sum(bool(part.held_out) for part in one.logs) == 1
    most = split_by_share(logs[:2], 0.99, seed=0)
    assert sum(bool(part.training) for part in most.logs) == 1
    given = split_given(logs[:1], logs[1:])
    assert [len(part.held_out) for part in given.logs] == [0, 10, 10, 10, 10]


def test_the_end_of_a_single_log_is_held_out() -> None:
    split = split_by_share([log_of(101)], 0.2, seed=0)
    part = split.logs[0]
    assert (len(part.training), len(part.held_out)) == (80, 21)
    assert part.training[-1].log_time_ns < part.held_out[0].log_time_ns
    assert "the only log" in split.rule
    assert "20.0 s" in split.rule
    with pytest.raises(InvalidInputError, match="both sides"):
        split_by_share([log_of(1)], 0.2, seed=0)
    for share in (0.0, 1.0, float("nan")):
        with pytest.raises(InvalidInputError, match="held-out-share"):
            split_by_share([log_of(10)], share, seed=0)


def test_thinning_keeps_the_ends() -> None:
    log = log_of(100)
    thin(log, 5)
    seconds = [(state.stamp_ns - START) // SECOND for state in log.states]
    assert seconds == [0, 25, 50, 74, 99]
    thin(log, 1000)
    assert len(log.states) == 5


def test_the_same_log_twice_is_refused(tmp_path: Path) -> None:
    entries = [vehicle_state(START)]
    first, second = write(tmp_path / "a", entries), write(tmp_path / "b.mcap", entries)
    digests = file_digests(first)
    assert list(digests) == ["a_0.mcap"]
    other = write(tmp_path / "c", [vehicle_state(START + 1)])
    check_new(other, file_digests(other), {first: digests})
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((first / "a_0.mcap").read_bytes())
    with pytest.raises(InvalidInputError, match="each log once; its content is in"):
        check_new(copy, file_digests(copy), {second: file_digests(second), first: digests})


def test_the_version_of_this_code() -> None:
    found = code_version()
    assert found["version"]
    revision = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    if revision.returncode == 0:
        assert found["git_revision"] == revision.stdout.strip()
        assert found["git_changed_files"] >= 0
    else:
        assert found["git_revision"] is None


def test_memory_holds_states_not_messages(tmp_path: Path) -> None:
    """40 MB of messages, of which 2000 states of some 100 bytes are kept."""
    path = tmp_path / "large"
    filler = String(data="x" * 20_000)
    with BagWriter(path, compression="none") as bag:
        bag.add_topic("/planner/vehicle_state", JointState, Qos())
        bag.add_topic("/planner/story", String, Qos())
        for k in range(2000):
            bag.write(*vehicle_state(START + k * SECOND))
            bag.write("/planner/story", filler, START + k * SECOND)
    # ru_maxrss would count the memory of the parent, which the child shares at first.
    program = (
        "import sys; from ros.test_tuning_logs import *; "
        "peak = lambda: int(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0]); "
        "read(BAGS / 'powered_descent_nominal'); before = peak(); "
        "assert len(read(Path(sys.argv[1])).states) == 2000; print(peak() - before)"
    )
    search = os.pathsep.join((str(ROOT / "tests"), str(ROOT)))
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        env={**os.environ, "PYTHONPATH": search},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    kilobytes = int(done.stdout)
    assert kilobytes < 15_000, kilobytes
