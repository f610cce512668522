# SPDX-License-Identifier: Apache-2.0

"""Faults of an experiment: keys, hashes, and what they do to the link."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment, load_link
from cloudrc.config.resolved import dump, fingerprint
from cloudrc.flight.experiment import check_mode
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.wire.messages import GuardState
from tests.config.conftest import refused_line

KILLED = "kind: cloud_killed, at_s: 4, duration_s: 0.8"
IDEAL, STEPS = "link.profile=ideal", "mission.steps.count=2"


def faulty(*faults, settings=()):
    texts = ", ".join(f"{{{fault}}}" for fault in faults)
    return load_experiment("steps", [IDEAL, STEPS, f"faults=[{texts}]", *settings])


def test_without_faults_nothing_changes_and_with_them_the_file_repeats_the_flight(tmp_path):
    bare = load_experiment("steps")
    assert "faults" not in dump(bare)
    assert fingerprint(load_experiment("steps", ["faults=[]"])) == fingerprint(bare)
    with_fault = faulty("kind: partition, at_s: 12, duration_s: 0.8")
    assert fingerprint(with_fault) != fingerprint(faulty())
    (tmp_path / "again.yaml").write_text(dump(with_fault))
    assert load_experiment(tmp_path / "again.yaml") == with_fault


def test_faults_are_in_the_schedule_of_their_direction():
    found = faulty(
        "kind: partition, at_s: 5, duration_s: 1, direction: uplink",
        "kind: burst, at_s: 4, duration_s: 2, packets: 20, direction: downlink",
        "kind: ramp, at_s: 3, duration_s: 1.05, delay_ms: 105, direction: downlink",
        settings=["link.downlink.changes=[{at_s: 3.5, delay_ms: 50}]", "link.start_s=2"],
    )
    (cut,) = found.uplink.blackouts
    assert (cut.start_s, cut.duration_s, found.uplink.changes) == (7.0, 1.0, ())
    assert found.downlink.blackouts == ()
    line = {round(each.at_s, 6): each for each in found.downlink.changes}
    assert [*line] == sorted(line)
    assert [round(line[t].delay_ms, 6) for t in (3.5, 5.0, 5.1, 6.0, 6.05)] == [50, 60, 70, 155, 50]
    assert [getattr(line[t].loss, "bad_end", 0) for t in (5.9, 6.0, 8.0)] == [0, 0.05, 0]
    assert found.link_values["uplink"]["blackouts"][0]["start_s"] == 7.0


def test_a_partition_makes_the_robot_hold_while_it_lasts():
    fault = "kind: partition, at_s: 4, duration_s: 0.8"
    guard = fly_in_memory(faulty(fault)).flight.recording["/guard"]
    held = guard["stamp_ns"][guard["state"] == GuardState.HOLD] * 1e-9
    assert 4.0 < held[0] < 4.3


@pytest.mark.parametrize(
    ("fault", "setting", "said"),
    [
        ("kind: cut, at_s: 1, duration_s: 1", STEPS, "faults.0.kind"),
        ("kind: burst, at_s: 1, duration_s: 1", STEPS, "burst needs packets"),
        ("kind: ramp, at_s: 1, duration_s: 1, delay_ms: 9, packets: 2", STEPS, "has no packets"),
        ("kind: partition, at_s: 1, duration_s: 1", "link.profile=handover", "repeats"),
        ("kind: cloud_killed, at_s: 1", STEPS, "cloud_killed needs duration_s"),
        ("kind: clock_step, at_s: 1, step_s: -1", STEPS, "faults.0.step_s"),
        ("kind: clock_step, at_s: 1, step_s: 1, duration_s: 1", STEPS, "has no duration_s"),
        ("kind: world_paused, at_s: 1, duration_s: 1, direction: uplink", STEPS, "no direction"),
        ("kind: cloud_paused, at_s: 1, duration_s: 1", "fleet.robots=2", "a fleet can only"),
        (f"{KILLED}}}, {{kind: cloud_paused, at_s: 4.5, duration_s: 1", STEPS, "cloud overlap"),
    ],
)
def test_what_is_impossible_is_refused_in_one_line(fault, setting, said):
    round_ = ["link.start_s=random"] if "handover" in setting else []
    assert said in refused_line("steps", setting, *round_, f"faults=[{{{fault}}}]")


def test_a_second_fault_of_a_process_begins_later_than_the_first_one_ends():
    paused = "kind: cloud_paused, at_s: 3, duration_s: 1"
    assert len(faulty(paused, KILLED.replace("4", "4.1")).faults) == 2
    with pytest.raises(BadInputError, match="cloud overlap"):
        faulty(paused, KILLED)  # at 4 s


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        (["kind: clock_step, at_s: 1, step_s: 1"], "faults: clock_step acts in virtual time only"),
        ([KILLED, KILLED.replace("4", "9")], "faults: .*cloud_killed is possible once"),
    ],
)
def test_what_real_time_cannot_inject_is_refused_with_the_key(faults, said):
    found = faulty(*faults)
    check_mode(found, "virtual")
    with pytest.raises(BadInputError, match=said):
        check_mode(found, "local")


def test_a_cluster_names_the_command_that_injects(tmp_path):
    found = faulty("kind: partition, at_s: 1, duration_s: 1")
    with pytest.raises(BadInputError, match=r"faults: .*kubectl delete pod"):
        check_mode(found, "cluster")
    link, experiment = tmp_path / "link.yaml", tmp_path / "experiment.yaml"
    link.write_text("profile: null\n")
    experiment.write_text(dump(found))
    with pytest.raises(BadInputError, match=r"experiment.yaml: faults: .*kubectl delete pod"):
        load_link(link, experiment)
