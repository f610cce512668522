"""Random compositions of faults break no invariant; one that does is shrunk and kept."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.errors import BadInputError
from cloudrc.faults.adversary import POLICIES, choose, temptation
from cloudrc.faults.flight import Flight
from cloudrc.faults.fuzz import Finding, fly, judged
from cloudrc.faults.invariants import Watch
from cloudrc.faults.remains import KILLED, Remains
from cloudrc.faults.schedule import (
    CALM,
    KINDS,
    Event,
    Schedule,
    calm,
    compose,
    dump,
    load,
    shaped,
    shrink,
)
from cloudrc.link.profile import Change, DirectionProfile
from cloudrc.messages import OperatorRequest, Request
from cloudrc.record.columns import Recording
from cloudrc.record.recover import Recovery, recover
from cloudrc.world.endpoint import WorldEndpoint

REGRESSIONS = sorted((Path(__file__).parent / "regressions").glob("*.yaml"))


@pytest.mark.parametrize("path", REGRESSIONS, ids=lambda path: path.stem)
def test_what_was_found_once_stays_mended(path: Path) -> None:
    finding = fly(load(path))
    assert (finding.breaches, finding.thrown) == ((), 0.0)


@pytest.mark.parametrize("seed", range(1, 5))
def test_random_faults_break_no_invariant(seed: int) -> None:
    assert fly(compose(seed)).breaches == ()


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_a_hostile_cloud_causes_no_breach(policy: str) -> None:
    seeds = [seed for seed in range(1, 30) if choose(seed).policy == policy]
    assert fly(replace(choose(seeds[0]), duration=12.0)).breaches == ()


@pytest.mark.full
@pytest.mark.parametrize("first", range(1, 201, 25))
def test_two_hundred_hostile_clouds_cause_no_breach(first: int) -> None:
    findings = [fly(choose(seed)) for seed in range(first, first + 25)]
    assert [each.schedule.seed for each in findings if each.breaches or each.thrown] == []


def test_an_adversary_flies_alone_or_amid_every_kind_of_fault() -> None:
    chosen = [choose(seed) for seed in range(400)]
    alone = [schedule for schedule in chosen if not schedule.events]
    assert 150 < len(alone) < 250
    assert {event.kind for schedule in chosen for event in schedule.events} == set(KINDS)
    for policy in POLICIES:
        mine = [bool(schedule.events) for schedule in chosen if schedule.policy == policy]
        assert set(mine) == {True, False}


def test_the_operator_attack_sends_all_requests_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    heard: list[OperatorRequest] = []
    receive = WorldEndpoint._receive_operator

    def hear(world: WorldEndpoint, request: OperatorRequest, now_ns: int) -> None:
        heard.append(request)
        receive(world, request, now_ns)

    monkeypatch.setattr(WorldEndpoint, "_receive_operator", hear)
    for seed in (27, 38):
        assert fly(Schedule(seed, policy="operators-voice", duration=20.0)).breaches == ()
    said = [request for request in heard if request.mission_id < 3]
    assert {request.request for request in said} == set(Request)
    of_operator = [request for request in heard if request not in said]
    assert {request.request for request in of_operator} == {Request.START}, "before it was muted"


def test_what_the_guard_lands_for_is_acknowledged_in_the_air() -> None:
    schedule = Schedule(3, policy="refused-and-released")
    flight = Flight(seed=schedule.seed, honest=False, tempt=temptation(schedule)).fly(15.0)
    causes = [change.cause for change in flight.changes]
    assert causes.count("acknowledged before touch-down") == 2
    assert flight.watch.counts == {}


def test_a_fall_by_operator_stop_is_reported_without_failing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def falling(schedule: Schedule, keep: bool = False) -> Finding:
        return Finding(schedule, (), "", 1.0, 2.0, 0, 1, 0.4 * (schedule.seed % 2))

    monkeypatch.setattr("cloudrc.faults.fuzz.fly", falling)
    page = tmp_path / "adversary.md"
    assert main(["faults", "fuzz", "--adversarial", "--seeds", "4", f"--document={page}"]) == 0
    told = "2 came to rest outside of it after an emergency stop, at most by 0.40 m"
    assert told in page.read_text()
    command = f"cloudrc faults fuzz --adversarial --seeds 4 --document {page}"
    assert f"Written by `{command}`" in page.read_text()
    assert told in capsys.readouterr().out


def test_one_seed_is_one_flight() -> None:
    first, second = (fly(compose(5), keep=True) for _ in range(2))
    assert first == second
    assert first.sha256 != fly(compose(6), keep=True).sha256


def test_every_kind_of_fault_occurs_and_ends_before_the_calm() -> None:
    events = [event for seed in range(400) for event in compose(seed).events]
    assert {event.kind for event in events} == set(KINDS)
    assert max(event.end for event in events) <= CALM


def test_a_schedule_is_what_its_file_says(tmp_path: Path) -> None:
    path = tmp_path / "schedule.yaml"
    for schedule in (compose(8), choose(3), Schedule(2), Schedule(2, apart=True, hold_max=2.5)):
        path.write_text(dump(schedule, "a note\nof two lines"))
        assert load(path) == schedule


@pytest.mark.parametrize(
    "text",
    [
        "",
        "seed: 1\nevents: [{kind: rain, at: 1}]",
        "[1, 2]",
        "seed: 1\nwind: 3",
        "{{",
        "[" * 5000,
        "seed: -1",
        "seed: one",
        "seed: 1\nduration: 0",
        "seed: 1\nduration: .inf",
        "seed: 1\nreorder: 2",
        "seed: 1\napart: perhaps",
        "seed: 1\nevents: [{kind: blackout, at: nan}]",
        "seed: 1\nevents: [{kind: blackout, at: .nan}]",
        "seed: 1\nevents: [{kind: blackout, at: -1}]",
        "seed: 1\nevents: [{kind: blackout, at: 1, duration: -3}]",
        "seed: 1\nevents: [{kind: loss, at: 1, duration: 3, value: 1.5}]",
        "seed: 1\nevents: [{kind: blackout, at: 1, way: left}]",
        "seed: 1\nevents: [{kind: blackout}]",
    ],
)
def test_what_is_no_schedule_is_bad_input(tmp_path: Path, text: str) -> None:
    path = tmp_path / "schedule.yaml"
    path.write_text(text)
    with pytest.raises(BadInputError, match=r"schedule\.yaml: is no schedule of faults"):
        load(path)


@pytest.mark.parametrize("line", ["policy: nope", "profile: nope"])
def test_a_schedule_that_names_what_there_is_not_is_bad_input(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "schedule.yaml"
    path.write_text(f"seed: 1\n{line}\n")
    assert main(["faults", "replay", str(path)]) == 2
    error = capsys.readouterr().err
    assert f"{path}: " in error
    assert "nope" in error


def test_a_link_fault_keeps_the_time_line_of_the_profile() -> None:
    profile = DirectionProfile(changes=(Change(5.0, delay=0.1),))
    silence, waves = Event("blackout", 1.0, 1.0), Event("loss", 1.0, 1.0, 0.5)
    assert shaped(Schedule(1, events=(silence,)), profile, "up").changes == profile.changes
    with pytest.raises(BadInputError, match="has a time line, on which loss cannot be laid"):
        shaped(Schedule(1, events=(waves,)), profile, "up")


def test_a_failing_schedule_is_shrunk_to_what_it_takes() -> None:
    def fails(schedule: Schedule) -> bool:
        kinds = {event.kind for event in schedule.events}
        return {"blackout", "loss"} <= kinds and schedule.seed == 5

    noise = [Event(kind, 0.5 + n, 1.0) for n, kind in enumerate(sorted(KINDS))]
    smallest = shrink(Schedule(5, "lte", tuple(noise), reorder=0.2, cloud_drift=9), fails)
    assert sorted(event.kind for event in smallest.events) == ["blackout", "loss"]
    assert (smallest.profile, smallest.reorder, smallest.cloud_drift) == ("paper-p2", 0.0, 0)


def test_the_watch_judges_by_its_own_fence(monkeypatch: pytest.MonkeyPatch) -> None:
    """The invariants can fail: where the fence is nearer than the guard believes, they do."""
    monkeypatch.setattr("cloudrc.faults.invariants.HIGH", (1.5, 1.5, 1.5))
    hostile = Schedule(8, "ideal", policy="towards-a-face", duration=10.0)
    assert {"fence", "stop"} <= fly(hostile).kinds


def test_the_watch_counts_the_age_of_commands_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.faults.flight._watch", lambda _: Watch(6.0, 12.0, 1.0, 50_000_000))
    assert fly(Schedule(1, "paper-p2", duration=5.0)).kinds == {"stale"}


def test_no_zero_is_told_of_what_was_not_looked_at(capsys: pytest.CaptureFixture[str]) -> None:
    alone = next(seed for seed in range(20) if not choose(seed).events)
    flags = ["--adversarial", "--first", str(alone), "--seeds", "1"]
    assert main(["faults", "fuzz", *flags, "-o", "json"]) == 0
    document = json.loads(capsys.readouterr().out)
    for kind, told in document["invariants"].items():
        if kind in ("collision", "obeyed", "waypoint", "stuck", "alarm", "recording"):
            assert told == {"judged": 0, "broken": None, "bound": None}
        else:
            assert told == {"judged": 1, "broken": 0, "bound": 1.0}, "p is never above 1"


def test_a_flight_too_short_to_recover_is_not_judged_stuck() -> None:
    late = Schedule(1, events=(Event("blackout", 44.0, 8.0),))
    assert "stuck" in judged(replace(late, duration=62.0))
    assert "stuck" not in judged(replace(late, duration=61.0))


@pytest.mark.parametrize("kind", sorted(set(Remains.KINDS) - set(KILLED)))
def test_what_a_bad_disk_leaves_of_a_recording_is_judged(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    value = 60_000.0 if kind == "recorder_full" else 0.4
    schedule = Schedule(1, events=(Event(kind, 2.0, 4.0, value),), duration=8.0)
    assert fly(schedule).breaches == ()
    monkeypatch.setattr("cloudrc.faults.remains.recover", _forgets_the_first)
    assert fly(schedule).kinds == {"recording"}


def _forgets_the_first(source: Path, target: Path) -> Recovery:
    recovery = recover(source, target)
    recording = Recording.read(target)["/ground_truth"]
    assert len(recording) > 50
    recovery.bytes_lost = 1
    return recovery


@pytest.mark.parametrize("value", [1.0, 30.0, 60.0])
def test_a_torn_journal_loses_one_entry_and_the_mission_goes_on(value: float) -> None:
    schedule = Schedule(3, events=(Event("journal_torn", 9.0, 1.0, value),), duration=25.0)
    assert fly(schedule).breaches == ()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_clean_flight_raises_no_alarm(seed: int) -> None:
    finding = fly(calm(seed))
    assert (finding.breaches, finding.holds, finding.missions) == ((), 0, 1)


def test_an_alarm_in_a_clean_flight_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    from cloudrc.faults import fuzz

    slow = replace(calm(1), profile="paper-p3")
    monkeypatch.setattr(fuzz, "shaped", lambda schedule, profile, way: replace(profile, delay=0.12))
    assert fly(slow).kinds == {"alarm"}
