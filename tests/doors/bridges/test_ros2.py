# SPDX-License-Identifier: Apache-2.0

"""A node of ROS 2 controls the robot: `make ros2-test` runs these tests in a real ROS 2."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.doors.cli.main import main
from cloudrc.flight.local.companion import companion
from cloudrc.flight.virtual.flight import fly_virtual
from cloudrc.results.record.columns import Recording, RecordStore
from tests.doors.bridges.conftest import needs_ros

pytestmark = needs_ros
ROOT = Path(__file__).parents[3]
SHORT = ("mission.waypoints=[{position_m: [0.5, 0, 0.7], dwell_s: 0.5}]", "mission.touch=null")


def ros2(kind, namespace=""):
    """Return the command of a node of the tests."""
    return f"{sys.executable} -m tests.doors.bridges.node {kind} {namespace}"


def example(names="controller", namespace=""):
    """Return the command of the example's nodes."""
    more = f" --ros-args -r __ns:=/{namespace}" if namespace else ""
    path = f"PYTHONPATH={ROOT}/examples/ros2"
    return f"env {path} {sys.executable} -m cloudrc_nodes {names}{more}"


def built_in(settings, **how):
    """Fly in virtual time; return the true path."""
    store = RecordStore()
    fly_virtual(load_experiment("paper", settings), store.add, **how)
    truth = Recording(records=store)["/ground_truth"]
    return np.column_stack((truth["stamp_ns"], truth["position"], truth["velocity"]))


def with_nodes(settings, command, folder):
    with companion(command, folder) as gone:
        return built_in(settings, gone=gone)


@pytest.mark.smoke
def test_the_papers_controller_as_a_node_flies_the_path_of_the_built_in_one_bit_by_bit(tmp_path):
    path = with_nodes(["cloud.controller=ros2"], example(), tmp_path)
    assert np.array_equal(path, built_in([]))
    assert len(path) > 1000


@pytest.mark.full
@pytest.mark.parametrize("delay_ms", [0, 200, 500])
def test_moonshot_the_node_flies_the_built_in_path_over_a_long_and_lossy_link(delay_ms, tmp_path):
    settings = [
        "link.profile=ideal", f"link.both.delay_ms={delay_ms}", "link.both.loss=0.1",
        "guard.command_age_max_ms=1500", "cloud.freeze_after_s=1.2", "cloud.horizon_max_s=2",
        "cloud.predictor=model_based",
    ]  # fmt: skip
    path = with_nodes([*settings, "cloud.controller=ros2"], example(), tmp_path)
    assert np.array_equal(path, built_in(settings))
    assert first_touch(path) > 0


def first_touch(path):
    """Return the time at which the path is at the board [s]."""
    return path[np.argmax(path[:, 1] > 8.1), 0] * 1e-9


def test_estimator_predictor_teleoperation_and_controller_fly_as_nodes_and_repeat(tmp_path):
    settings = ["cloud.controller=ros2", "cloud.predictor=last_sample"]
    path, again = (with_nodes(settings, example(""), tmp_path) for _ in range(2))
    assert np.array_equal(path, again)
    assert first_touch(path) == pytest.approx(first_touch(built_in([])), rel=0.03)


def run(tmp_path, kind, *words, mode="virtual"):
    """Fly with a node of the tests; return the exit code, and the report if there is one."""
    words = ["run", "hover", "--mode", mode, "--out", str(tmp_path / "run"), *words]
    words += [word for setting in SHORT for word in ("--set", setting)]
    command = ros2(kind) if " " not in kind else kind
    code = main([*words, "--set", "cloud.controller=ros2", "--with", command])
    path = tmp_path / "run" / "report.json"
    return code, json.loads(path.read_text()) if path.exists() else None


NO_PROGRAM = f"{sys.executable} -m no_such_node"
WRONG = [
    ("nan", "virtual", "controller_invalid", "node /nan sends a velocity that is not finite"),
    ("stamp", "virtual", "controller_invalid", "copy its header.stamp"),
    ("twice", "virtual", "controller_invalid", "node /twice answers an estimate twice"),
    ("silent", "virtual", "controller_silent", "no answer on /cloudrc/cmd_vel within 2 s"),
    ("type", "virtual", "", "publishes geometry_msgs/msg/PoseStamped"),
    ("unstamped", "virtual", "", "publishes geometry_msgs/msg/Twist; cloudrc needs"),
    ("latched", "virtual", "", "RELIABLE, TRANSIENT_LOCAL, which cannot match cloudrc's"),
    ("tardy", "local", "", "node /tardy answers too late"),
    ("killed", "local", "controller_silent", "node /killed"),
    ("slow", "local", "controller_silent", "node /slow"),
    (NO_PROGRAM, "virtual", "", "No module named no_such_node"),
    (NO_PROGRAM, "local", "", "No module named no_such_node"),
]
"""Node, mode, code of the failure in the report ("": refused before the flight), last line."""


@pytest.mark.parametrize(("kind", "mode", "code", "text"), WRONG)
def test_a_wrong_node_ends_the_flight_with_one_line(tmp_path, capsys, kind, mode, code, text):
    exit_code, report = run(tmp_path, kind, mode=mode)
    assert exit_code == 5
    assert code in [failure["code"] for failure in report["failures"]] if code else report is None
    assert text in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("mode", "second"), [("virtual", "second"), ("local", "first")])
def test_two_nodes_cannot_command(tmp_path, capsys, mode, second):
    with companion(ros2("first"), tmp_path):
        code, _ = run(tmp_path, second, mode=mode)
    assert code == 5
    assert f"nodes /first and /{second} command both" in capsys.readouterr().err.splitlines()[-1]


def test_a_robot_has_a_namespace(tmp_path):
    settings = [*SHORT, "cloud.controller={name: ros2, namespace: drone1}"]
    path = with_nodes(settings, example(namespace="drone1"), tmp_path)
    assert np.array_equal(path, built_in(SHORT))


@pytest.mark.parametrize("kind", [example(), "unstamped"])
def test_a_node_flies_in_real_time_and_a_word_tells_of_commands_without_a_stamp(
    tmp_path, capsys, kind
):
    _, report = run(tmp_path, kind, mode="local")
    assert report["numbers"]["waypoints_reached"]["value"] == 1
    assert ("/cloudrc/cmd_vel, which has no stamp" in str(capsys.readouterr())) is (
        kind == "unstamped"
    )


@pytest.mark.smoke
@pytest.mark.alone
def test_a_node_that_is_killed_and_comes_back_in_real_time_goes_on(tmp_path):
    again = ros2("again --ros-args -r __node:=killed")
    _, report = run(tmp_path, f"sh -c '{ros2('killed')}; {again}'", mode="local")
    assert report["numbers"]["waypoints_reached"]["value"] == 1
    assert report["numbers"]["controller_gaps"]["value"] >= 1
