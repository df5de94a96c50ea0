"""A problem that no package knows, through the node and the tuner, over real topics."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros.any_problem_support import (
    PLAN_TIMEOUT_S,
    STATE,
    STRANGER_IN_SPACE,
    running,
    stranger,
    write_log,
)
from ros.planner_support import LATCHED, START_TIMEOUT_S
from visualization_msgs.msg import MarkerArray

from dscp_core import problems
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.planner import Planner
from dscp_core.tuning import tuner
from dscp_core.workers.processes import SerialEngine
from dscp_ros.cli import ExitCode
from dscp_ros.cli import main as frame
from dscp_ros.parameter_set import PARAMETERS_FILE, ParameterSetError, load, save
from dscp_ros.planner.choice import ProblemChoice
from dscp_ros.planner.parameters import node_settings, parameter_table
from dscp_ros.tuning.start import read_start
from msg_adapters.errors import InputCode
from msg_adapters.odometry import odometry_from_kinematics
from msg_adapters.report import PlanReport
from msg_adapters.state import Kinematics
from msg_adapters.trajectory import plan_from_trajectory

DISTRIBUTION = {
    "METADATA": "Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n",
    "entry_points.txt": "[dscp.problems]\nhockey = puck_module:made\n",
}


@pytest.fixture
def puck(tmp_path: Path) -> str:
    return stranger(tmp_path)


def planned_here(name: str, state: np.ndarray, **values: object):
    """The plan that the node's settings give in this process."""
    problem = problems.get(name)
    defaults = {p.name: p.default for p in parameter_table(problem)}
    return Planner(problem, node_settings(problem, {**defaults, **values}).planner).plan(state)


def test_states_come_in_and_certified_plans_come_out(ros, puck):
    problem = problems.get(puck)
    with running(ros, problem, "-p", f"problem:={puck}") as (client, process):
        report = client.report()
        assert (report.problem, report.code) == ("puck", PlanStatus.CERTIFIED), report.message
        assert report.state == dict(
            zip(("east", "north", "speed_east", "code"), STATE, strict=True)
        )
        assert list(report.certificate.values) == ["miss_place_m"]
        assert {c.name for c in report.certificate.checks} >= {"miss_place", "push_x_max"}
        assert report.attempt.terminal_time_source == "fixed"

        trajectory = client.trajectories[-1]
        assert trajectory.header.frame_id == "world"
        states = ["east", "north", "speed_east", "code"]
        assert list(trajectory.joint_names) == [*states, "push_east", "push_north"]
        assert len(trajectory.points) == 31
        plan, stamp_ns = plan_from_trajectory(trajectory, client.layout)
        assert stamp_ns == report.input_stamp_ns
        expected = planned_here(puck, STATE)
        assert expected.status is PlanStatus.CERTIFIED
        for field in ("states", "controls", "state_rates"):
            given, wanted = getattr(plan, field), getattr(expected.plan, field)
            np.testing.assert_allclose(given, wanted, rtol=1e-6, atol=1e-8)
        assert plan.control_names == ("push_east", "push_north")
        assert report.attempt.cost == pytest.approx(expected.cost, rel=1e-6)

        # No scene, so no drawings; no odometry, so nobody listens to it.
        for topic in ("path", "markers"):
            assert client.node.count_publishers(f"/planner/{topic}") == 0
        for topic in ("state", "mass"):
            assert client.node.count_subscribers(f"/planner/{topic}") == 0

        answer = client.call("plan")
        assert answer.success, answer.message
        assert client.call("reset").success
        assert not client.call("plan").success
        assert client.report(STATE + 0.1).code == PlanStatus.CERTIFIED

        # What it declares bounds its inputs.
        for index, value, field in (
            (1, 51.0, "north"),
            (2, -10.0, "speed_east"),
            (0, -45.0, "place"),
        ):
            beyond = STATE.copy()
            beyond[index] = value
            refused = client.report(beyond)
            assert refused.code == InputCode.OUT_OF_RANGE
            assert refused.rejection.field == field

        # The problem is code: it stays what it was at the start, edited file or not.
        path = Path(puck.rpartition(":")[0])
        (result,) = set_parameters(ros, client, Parameter("problem", value="entry"))
        assert not result.successful
        path.write_text("this is no Python")
        assert client.call("reload").success
        assert client.report().code == PlanStatus.CERTIFIED
        assert process.poll() is None


def set_parameters(ros, client, *parameters: Parameter):
    service = client.node.create_client(SetParameters, "/planner/set_parameters")
    assert service.wait_for_service(START_TIMEOUT_S)
    request = SetParameters.Request(parameters=[p.to_parameter_msg() for p in parameters])
    future = service.call_async(request)
    assert ros.wait_for(future.done, PLAN_TIMEOUT_S)
    return future.result().results


def test_from_logs_to_a_set_and_back_into_the_node(ros, puck, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tuner, "make_engine", lambda setup, *_: SerialEngine(setup))
    random = np.random.default_rng(1)
    drawn = [[STATE + random.uniform(-0.05, 0.05, 4) for _ in range(4)] for _ in range(2)]
    logs = [write_log(tmp_path / f"log{k}", puck, states) for k, states in enumerate(drawn)]
    folder = tmp_path / "sets" / "tuned"
    tuned = ["tune", *map(str, logs), "--problem", puck, "--output", str(folder), "--workers", "1"]
    tuned += ["--held-out-share", "0.5", "--epochs", "2"]
    weak = tmp_path / "weak.yaml"
    weak.write_text("/**: {ros__parameters: {parameters: {push_max: 1.0}}}")
    tuned += ["--params-file", str(weak), "--parameters", "push_max=0.5:4"]
    assert frame.main(tuned) == ExitCode.OK
    assert "loss (cost)" in capsys.readouterr().out

    choice = ProblemChoice.read(puck)
    made = load(folder, choice)
    content = yaml.safe_load((folder / PARAMETERS_FILE).read_text())["/**"]["ros__parameters"]
    assert "problem" not in content
    assert "formulation" not in content
    assert made.problem == made.provenance["problem"] == "puck"
    assert made.provenance["problem_source"]["name"] == puck
    push_max = made.values["parameters.push_max"]
    assert push_max > 1.0
    assert made.values["parameters.drag"] == 0.3
    with pytest.raises(ParameterSetError, match="puck"):
        load(folder)

    files = ["--params-file", str(folder / PARAMETERS_FILE)]
    with running(ros, problems.get(puck), *files, "-p", f"problem:={puck}") as (client, _):
        report = client.report()
        assert report.code == PlanStatus.CERTIFIED
        assert report.parameter_set.startswith(made.label)
        expected = planned_here(puck, STATE, **{"parameters.push_max": push_max})
        assert report.attempt.cost == pytest.approx(expected.cost, rel=1e-6)

        # With a fixed terminal time, a plan starts with what is left of the last one.
        assert client.call("reset").success
        known = len(client.reports)
        replay = subprocess.run(
            [sys.executable, "-m", "dscp_ros.replay", str(logs[0]), "--restamp",
             "--wait-for-subscribers", "1"],
            env=ros.child_env(),
            capture_output=True,
            text=True,
            timeout=START_TIMEOUT_S,
        )  # fmt: skip
        assert replay.returncode == 0, replay.stderr
        assert ros.wait_for(lambda: len(client.reports) > known, PLAN_TIMEOUT_S)
        assert {r.code_name for r in client.reports[known:]} == {"CERTIFIED"}
        assert client.call("reset").success

        again = save(folder, {**made.values, "intervals": 20}, choice=choice, overwrite=True)
        answer = client.call("reload")
        assert answer.success, answer.message
        assert again.label in answer.message
        assert client.report().parameter_set.startswith(again.label)
        assert len(client.trajectories[-1].points) == 21

        # A set that names a file is refused before the file is run; the old one stays.
        spoil(folder, "problem: " + str(tmp_path / "other.py:puck"))
        (tmp_path / "other.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
        answer = client.call("reload")
        assert not answer.success
        assert "does not name a file" in answer.message
        assert client.report().parameter_set.startswith(again.label)
    message = refused(ros, tmp_path, *files)
    assert "does not name a file" in message
    for other in (folder / "more.yaml", tmp_path / "link.yaml"):  # another name, another place
        if other.parent == folder:
            other.write_text((folder / PARAMETERS_FILE).read_text())
        else:
            other.symlink_to(folder / PARAMETERS_FILE)
        assert "does not name a file" in refused(ros, tmp_path, "--params-file", str(other))
    with pytest.raises(ParameterSetError, match="does not name a file"):
        read_start([folder / PARAMETERS_FILE], "/planner", problem=puck)
    assert not (tmp_path / "ran").exists()


def spoil(folder: Path, line: str) -> None:
    """Add a parameter to a set, and make its checksums right."""
    from dscp_ros.parameter_set.format import file_digest, provenance_text, read_provenance

    parameters, provenance = folder / PARAMETERS_FILE, folder / "provenance.json"
    document = read_provenance(provenance)
    parameters.write_text(parameters.read_text() + f"    {line}\n")
    document["files"] = {PARAMETERS_FILE: file_digest(parameters)}
    provenance.write_text(provenance_text(document))


def test_an_installed_problem_is_known_by_its_name(ros, tmp_path, monkeypatch):
    stranger(tmp_path)
    (tmp_path / "puck.py").rename(tmp_path / "puck_module.py")
    info = tmp_path / "stranger-1.0.dist-info"
    info.mkdir()
    for name, text in DISTRIBUTION.items():
        (info / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    assert "hockey" in problems.names()
    choice = ProblemChoice.read("hockey")
    made = save(tmp_path / "set", {"intervals": 20}, choice=choice)
    assert made.values["problem"] == "hockey"
    assert made.problem == "puck"
    files = ["--params-file", str(tmp_path / "set" / PARAMETERS_FILE)]
    with running(ros, problems.get("hockey"), *files) as (client, _):
        report = client.report()
        assert report.code == PlanStatus.CERTIFIED
        assert report.parameter_set.startswith(made.label)


def refused(ros, folder: Path, *arguments: str) -> str:
    """What the node says when it refuses its arguments: one line."""
    result = subprocess.run(
        [sys.executable, "-m", "dscp_ros.planner.main", *arguments],
        cwd=folder,
        env=ros.child_env(),
        capture_output=True,
        text=True,
        timeout=START_TIMEOUT_S,
    )
    assert result.returncode == ExitCode.BAD_INPUT, result.stderr
    assert "Traceback" not in result.stderr
    (line,) = (line for line in result.stderr.splitlines() if "error:" in line)
    return line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("missing.py:puck", ("missing.py:puck", "a readable Python file")),
        ("notes.py:puck", ("notes.py:puck", "a Python file that can be run", "line 1")),
        ("puck.py:disc", ("puck.py:disc", "a name in puck.py", "puck")),
        ("puck.py:anything", ("puck.py:anything, int", "an OptimalControlProblem")),
        ("puck.py:failing", ("puck.py:failing", "no puck today")),
        ("hocky", ("hocky", "one of powered_descent, entry", "FILE.py:NAME")),
        ("stateless.py:problem", ("states",)),
        ("fixed.py:problem", ("initial_state_parameters of puck", "4 states")),
        ("raising.py:problem", ("dynamics", "wind", "raising.py:4")),
        ("careless.py:problem", ("check_parameters", "ZeroDivisionError", "careless.py:4")),
        ("costless.py:problem", ("cost",)),
    ],
)
def test_what_is_no_problem_is_refused_at_the_start(ros, tmp_path, text, words):
    stranger(tmp_path)
    (tmp_path / "notes.py").write_text("a puck, sliding\n")
    changed = (
        "from dataclasses import replace\nfrom puck import puck\nproblem = replace(puck, {})\n"
    )
    sys_path = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
    (tmp_path / "stateless.py").write_text(sys_path + changed.format("states=()"))
    without = changed.format("initial_state_parameters=()")
    (tmp_path / "fixed.py").write_text(sys_path + without)
    careless = changed.format("check_parameters=lambda values: 1 / 0")
    (tmp_path / "careless.py").write_text(sys_path + careless)
    costless = changed.format("running_cost=None, cost_terms=(), terminal_cost=None")
    (tmp_path / "costless.py").write_text(sys_path + costless)
    raising = changed.format("dynamics=lambda x, u, p: p['wind']")
    (tmp_path / "raising.py").write_text(sys_path + raising)
    line = refused(ros, tmp_path, "--ros-args", "-p", f"problem:={text}")
    for word in words:
        assert word in line


def test_a_set_of_another_problem_is_refused_by_name(ros, puck, tmp_path):
    choice = ProblemChoice.read(puck)
    save(tmp_path / "pucks", {"intervals": 20}, choice=choice)
    files = ["--params-file", str(tmp_path / "pucks" / PARAMETERS_FILE)]
    assert "puck" in refused(ros, tmp_path, *files)
    save(tmp_path / "landers", {"intervals": 40})
    files = ["--params-file", str(tmp_path / "landers" / PARAMETERS_FILE)]
    line = refused(ros, tmp_path, *files, "--ros-args", "-p", f"problem:={puck}")
    assert "powered_descent" in line
    assert "puck" in line


def test_a_parameter_file_may_name_the_problem(ros, tmp_path):
    stranger(tmp_path)
    plain = tmp_path / "mine.yaml"
    plain.write_text(
        f"/**: {{ros__parameters: {{problem: '{tmp_path}/puck.py:made', intervals: 12}}}}"
    )
    start = read_start([plain], "/planner")
    assert start.values.problem.name == "puck"
    assert start.values.planner.intervals == 12
    made = save(tmp_path / "set", {"parameters.drag": 0.1}, choice=start.values.choice)
    both = read_start([plain, made.directory / PARAMETERS_FILE], "/planner")
    assert both.origin["parameter_sets"] == [made.label]
    assert both.values.parameters["drag"] == 0.1
    with running(ros, start.values.problem, "--params-file", str(plain)) as (client, _):
        assert client.report().code == PlanStatus.CERTIFIED
        assert len(client.trajectories[-1].points) == 13
        plain.write_text(plain.read_text().replace("puck.py:made", "evil.py:made"))
        (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
        answer = client.call("reload")
        assert not answer.success
        assert "problem" in answer.message
        assert client.report().code == PlanStatus.CERTIFIED
    assert not (tmp_path / "ran").exists()


def test_fuel_is_no_loss_of_a_problem_without_a_mass(puck, tmp_path, capsys):
    log = write_log(tmp_path / "log", puck, [STATE, STATE + 0.1])
    arguments = [
        "tune",
        str(log),
        "--problem",
        puck,
        "--parameters",
        "push_max=1:4",
        "--loss",
        "fuel",
    ]
    assert frame.main([*arguments, "--output", str(tmp_path / "set")]) == ExitCode.BAD_INPUT
    assert "puck has east, north, speed_east, code" in capsys.readouterr().err
    arguments += ["--topic", "state:=/planner/state"]
    assert frame.main([*arguments, "--output", str(tmp_path / "set")]) == ExitCode.BAD_INPUT
    assert "one of vehicle_state, report" in capsys.readouterr().err


def test_the_command_line_names_the_problem_and_its_path_may_be_odd(ros, tmp_path):
    folder = tmp_path / "it's #1: here"
    folder.mkdir()
    puck = stranger(folder)
    with running(ros, problems.get(puck), before=("--problem", puck)) as (client, _):
        assert client.report().code == PlanStatus.CERTIFIED


def test_a_problem_may_bring_odometry_settings_and_a_scene(ros, tmp_path):
    text = f"{shutil.copy(STRANGER_IN_SPACE, tmp_path / 'drone.py')}:drone"
    problem = problems.get(text)
    state = np.array([40.0, 1.0, -2.0, -3.0, 0.5, 0.0])
    with running(ros, problem, "-p", f"problem:={text}", "-p", "site_frame:=pad") as (client, _):
        node = client.node
        paths: list[Path] = []
        drawings: list[MarkerArray] = []
        node.create_subscription(PathMessage, "/planner/path", paths.append, LATCHED)
        node.create_subscription(MarkerArray, "/planner/markers", drawings.append, LATCHED)
        publisher = node.create_publisher(Odometry, "/planner/state", 10)
        assert ros.wait_for(lambda: publisher.get_subscription_count() > 0)
        assert node.count_subscribers("/planner/mass") == 0

        def send(height_m: float) -> PlanReport:
            stamp_ns = time.time_ns()
            kinematics = Kinematics(stamp_ns, np.array([1.0, -2.0, height_m]), state[[4, 5, 3]])
            publisher.publish(odometry_from_kinematics(kinematics, frame="pad"))
            return client.report_of(stamp_ns)

        report = send(40.0)
        assert report.code == PlanStatus.CERTIFIED, report.message
        assert report.mass_source is None
        assert (report.state["x"], report.state["z"], report.state["vz"]) == (1.0, 40.0, -3.0)
        assert report.certificate.values.keys() == {"miss_place_m"}
        plan, _ = plan_from_trajectory(client.trajectories[-1], client.layout, frame="pad")
        np.testing.assert_allclose(plan.states[0], state, rtol=0.0, atol=1e-9)
        # Efforts stand at the velocities that they act on.
        effort = np.array(client.trajectories[-1].points[0].effort)
        np.testing.assert_array_equal(effort[[5, 3, 4]], plan.controls[0])
        assert ros.wait_for(lambda: bool(paths and drawings))
        first = paths[-1].poses[0].pose.position
        assert (first.x, first.y, first.z) == pytest.approx((1.0, -2.0, 40.0))
        by_name = {marker.ns: marker for marker in drawings[-1].markers}
        assert by_name.keys() == {"path", "push", "ground", "site"}
        assert by_name["site"].scale.x == 2.0 * 3.0

        below = send(-1.0)
        assert below.code == InputCode.BELOW_GROUND
        assert below.rejection.field == "pose.pose.position.z"
        far = send(2000.0)
        assert far.code == InputCode.OUT_OF_RANGE

        # A scene that fails costs the picture only.
        (result,) = set_parameters(ros, client, Parameter("site_radius_m", value=0.0))
        assert result.successful
        report = send(39.0)
        assert report.published
        assert report.code == PlanStatus.CERTIFIED
