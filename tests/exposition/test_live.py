"""Current metrics of a process: histograms and counts of a flight, peer, mission, absent values."""

from __future__ import annotations

import math

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.exposition import table
from cloudrc.exposition.live import LiveMetrics
from cloudrc.exposition.parts import Histogram
from cloudrc.messages import ZERO, GuardState
from cloudrc.records import (
    Arrival,
    CommandApplied,
    Contact,
    Counted,
    GuardChange,
    Lateness,
    MissionEvent,
    Record,
    SessionOpened,
    TelemetrySent,
)
from tests.exposition.conftest import MS, period
from tests.flights.conftest import records

Flight = tuple[list[Record], list[Record]]


def value(live: LiveMetrics, name: str, *label_values: str) -> float:
    reading = live.read()[name]
    assert isinstance(reading, dict)
    return reading[label_values]


def histogram(live: LiveMetrics, name: str) -> Histogram:
    reading = live.read()[name]
    assert isinstance(reading, Histogram)
    return reading


def wake(at_ms: float, *, slip_ms: float = 0.0, lateness: float = 1e-4) -> Lateness:
    return Lateness(round((at_ms - slip_ms) * MS), "world", lateness, 2e-4, round(slip_ms * MS))


@pytest.fixture(scope="module")
def flight() -> Flight:
    return records(load_experiment("hover", ["link.profile=paper-p2"]))


def test_a_bucket_includes_its_upper_bound() -> None:
    values = Histogram((0.01, 0.1))
    for each in (0.005, 0.01, 0.0101, 5.0):
        values.observe(each)
    assert values.cumulative() == [2, 3, 4]
    assert values.total == pytest.approx(5.0251)


@pytest.mark.parametrize(("role", "index"), [("world", 0), ("cloud", 1)])
def test_one_way_delays_include_all_arrivals(flight: Flight, role: str, index: int) -> None:
    live = LiveMetrics(role)
    live.see(flight[index])
    delays = [r.delay for r in flight[index] if isinstance(r, Arrival)]
    name = "cloudrc_downlink_delay_seconds" if role == "world" else "cloudrc_uplink_delay_seconds"
    assert histogram(live, name).cumulative()[-1] == len(delays)
    assert histogram(live, name).total == pytest.approx(sum(delays))
    age = histogram(live, "cloudrc_age_of_information_seconds")
    assert min(delays) < age.total / age.cumulative()[-1] < 2 * max(delays)


@pytest.mark.promise("unknown-is-absent")
def test_without_a_shared_clock_one_way_delays_are_absent() -> None:
    experiment = load_experiment("hover", ["link.profile=paper-p1"])
    both = records(experiment, offset_ns=7_000_000_000)
    for role, of_end in zip(table.ENDS, both, strict=True):
        live = LiveMetrics(role)
        live.see(of_end)
        assert not any("age_of" in name or "link_delay" in name for name in live.read())
    assert histogram(live, "cloudrc_rtt_seconds").cumulative()[-1] > 100  # needs no shared clock


@pytest.mark.parametrize("offset_ns", [0, 7_000_000_000])
def test_command_age_is_that_of_its_odometry_in_track(offset_ns: int) -> None:
    """It needs no shared clock; on the ground and in HOLD no command is in use."""
    of_world, _ = records(load_experiment("hover", ["link.profile=paper-p2"]), offset_ns=offset_ns)
    basis_ns, ages, others = 0, [], 0
    for record in of_world:
        if isinstance(record, CommandApplied):
            basis_ns = record.basis_stamp_ns
        elif isinstance(record, TelemetrySent):
            in_use = record.telemetry.guard is GuardState.TRACK
            others += not in_use
            ages += [(record.stamp_ns - basis_ns) * 1e-9] if in_use else []
    assert others > 1
    live = LiveMetrics("world")
    live.see(of_world)
    age = histogram(live, "cloudrc_command_age_seconds")
    assert age.cumulative()[-1] == len(ages) > 500
    assert age.total == pytest.approx(sum(ages))
    assert 0.05 < min(ages) < max(ages) < 0.25


def test_a_round_trip_is_counted_once_per_echo() -> None:
    live = LiveMetrics("cloud")
    for k, rtt in enumerate((math.nan, 0.04, 0.04, 0.04, 0.05)):
        live.see([period(10 * k, 10 * k, rtt=rtt, loop_delay=rtt + 0.005)])
    assert histogram(live, "cloudrc_rtt_seconds").cumulative()[-1] == 2
    assert histogram(live, "cloudrc_loop_delay_seconds").total == pytest.approx(0.1)


def test_errors_and_terms_are_signed_and_by_axis() -> None:
    live = LiveMetrics("cloud")
    live.see(
        [
            period(
                0,
                0,
                setpoint=(1.0, 2.0, 3.0),
                measured=(0.0, 2.5, 3.0),
                derivative=(0.0, 0.0, -0.7),
            )
        ]
    )
    assert value(live, "cloudrc_tracking_error_meters", "x") == 1.0
    assert value(live, "cloudrc_tracking_error_meters", "y") == -0.5
    assert value(live, "cloudrc_pid_output", "z", "derivative") == -0.7
    assert live.read()["cloudrc_prediction_error_meters"] == {}  # no prediction compared yet


def test_counts_are_assigned_to_their_direction() -> None:
    live = LiveMetrics("world")
    totals = {"sent": 7, "late": 3, "stalls": 1, "held_seconds": 4, "unheard_of": 9}
    for name, total in totals.items():
        live.see([Counted(0, "world", name, total)])
    assert value(live, "cloudrc_datagrams_total", "uplink", "sent") == 7
    assert value(live, "cloudrc_datagrams_total", "downlink", "late") == 3
    assert value(live, "cloudrc_datagrams_total", "downlink", "used") == 0
    assert value(live, "cloudrc_world_stalls_total") == 1
    assert value(live, "cloudrc_guard_held_seconds_total") == 4


def test_counts_of_one_shaper_are_absent_with_the_other() -> None:
    relay, netem = LiveMetrics("link"), LiveMetrics("link")
    relay.see([Counted(0, "link", "released_early", 3)])
    netem.see([Counted(0, "link", "restored", 2)])
    early, restored = "cloudrc_link_released_early_total", "cloudrc_link_restored_total"
    assert value(relay, early) == 3
    assert value(netem, restored) == 2
    assert early not in netem.read()
    assert restored not in relay.read()


def test_guard_and_contacts_are_counted() -> None:
    live = LiveMetrics("world")
    assert value(live, "cloudrc_guard_state") == GuardState.GROUND
    live.see(
        [GuardChange(0, GuardState.TRACK, "mission started"), GuardChange(1, GuardState.HOLD, "")]
    )
    live.see(
        [
            Contact(0, body, ZERO, ZERO, ZERO, True)
            for body in ("board", "pipe_1", "pipe_3", "chair")
        ]
    )
    assert value(live, "cloudrc_guard_state") == GuardState.HOLD
    assert value(live, "cloudrc_guard_transitions_total", "hold") == 1
    contacts = live.read()["cloudrc_contacts_total"]
    assert isinstance(contacts, dict)
    assert {name for (name,), count in contacts.items() if count} == {"board", "pipe", "other"}
    assert contacts["pipe",] == 2


def test_the_real_time_factor_covers_the_last_ten_seconds() -> None:
    live = LiveMetrics("world")
    live.see([wake(0)])
    assert "cloudrc_real_time_factor" not in live.read()
    live.see([wake(10 * k) for k in range(1, 500)])
    assert value(live, "cloudrc_real_time_factor") == pytest.approx(1.0)
    # From 5 s on it loses 1 ms in 10 ms; at 20 s the window has only such periods.
    live.see([wake(10 * k, slip_ms=k - 500) for k in range(500, 2000)])
    assert value(live, "cloudrc_real_time_factor") == pytest.approx(0.9)
    assert value(live, "cloudrc_world_slip_seconds_total") == pytest.approx(1.499)


def test_period_and_lateness_of_the_loop() -> None:
    live = LiveMetrics("world")
    live.see([wake(0), wake(10), wake(30, slip_ms=5, lateness=0.01)])
    period_ = histogram(live, "cloudrc_loop_period_seconds")
    assert (period_.total, period_.cumulative()[-1]) == (pytest.approx(0.03), 2)
    assert histogram(live, "cloudrc_loop_lateness_seconds").total == pytest.approx(0.0102)
    assert value(live, "cloudrc_loop_busy_seconds_total") == pytest.approx(6e-4)


def heard(role: str, *seen: Record) -> bool:
    live = LiveMetrics(role)
    live.see(seen)
    assert live.end is not None
    return live.end.has_peer


@pytest.mark.parametrize("role", table.ENDS)
def test_an_end_has_a_peer_while_datagrams_arrive(role: str) -> None:
    opened = SessionOpened(0, role, 1, "")
    arrival = Arrival(1000 * MS, role == "cloud", 1, 0, math.nan, True)
    assert not heard(role)
    assert not heard(role, wake(0))
    assert heard(role, opened, wake(10))
    assert heard(role, opened, arrival, wake(2900))
    assert not heard(role, opened, arrival, wake(3100))
    again = SessionOpened(5000 * MS, role, 2, "")
    assert heard(role, opened, arrival, again, wake(5010))


@pytest.mark.parametrize("role", table.ENDS)
@pytest.mark.parametrize(("behind", "hears"), [(0, False), (1, True), (500, False)])
def test_a_replayed_datagram_is_no_sign_of_life(role: str, behind: int, hears: bool) -> None:
    """Replaying a captured datagram needs no key; a late one that is new does count."""
    opened = SessionOpened(0, role, 1, "")
    first, newest = (
        Arrival(100 * MS, role == "cloud", 1, counter, math.nan, True) for counter in (0, 600)
    )
    again = newest._replace(stamp_ns=2000 * MS, counter=600 - behind, used=False)
    assert heard(role, opened, first, newest, again, wake(2500)) == hears


@pytest.mark.parametrize("role", table.ENDS)
def test_a_gap_is_between_arrivals_of_a_session_despite_replays(role: str) -> None:
    live = LiveMetrics(role)
    live.see([SessionOpened(0, role, 1, "")])
    for at_ms, counter in (
        (500, 0),
        (510, 2),
        (550, 1),
        (600, 2),
        (750, 3),
    ):  # counter 2 is replayed
        live.see([Arrival(at_ms * MS, role == "cloud", 1, counter, math.nan, True)])
    live.see([SessionOpened(900 * MS, role, 2, "")])
    live.see([Arrival(990 * MS, role == "cloud", 2, 0, math.nan, True)])
    gap = histogram(live, "cloudrc_link_gap_seconds")
    assert gap.cumulative() == [2, 3, 3]
    assert gap.total == pytest.approx(0.01 + 0.04 + 0.2)


def test_world_has_a_peer_before_its_first_command() -> None:
    assert heard("world", SessionOpened(0, "world", 1, ""), wake(60_000))
    assert not heard("cloud", SessionOpened(0, "cloud", 1, ""), wake(60_000))


def test_a_start_from_spawn_opens_a_session_but_admits_no_cloud(flight: Flight) -> None:
    live = LiveMetrics("world")
    live.see(flight[0])
    assert value(live, "cloudrc_sessions_opened_total") == 2
    assert value(live, "cloudrc_clouds_admitted_total") == 1


def test_mission_metrics_follow_the_events() -> None:
    live = LiveMetrics("teleop")
    seen = []
    for event, waypoint in (
        ("started", 0),
        ("reached", 0),
        ("held", 1),
        ("goto", -1),
        ("resumed", 1),
        ("reached", 1),
        ("done", 1),
        ("goto", -1),
        ("started", 0),
        ("leg_timed_out", 0),
    ):
        live.see([MissionEvent(0, event, waypoint, "")])
        state = table.MISSION_STATES[int(value(live, "cloudrc_mission_state"))]
        seen.append((state, value(live, "cloudrc_mission_waypoint")))
    assert seen == [
        ("flying", 0),
        ("flying", 1),
        ("held", 1),
        ("held", 1),
        ("flying", 1),
        ("flying", 2),
        ("done", -1),
        ("starting", -1),
        ("flying", 0),
        ("failed", -1),
    ]
    assert value(live, "cloudrc_waypoints_reached_total") == 2
    assert value(live, "cloudrc_missions_total", "done") == 1
    assert value(live, "cloudrc_missions_total", "leg_timed_out") == 1


def test_a_cloud_with_separate_teleop_exposes_no_mission() -> None:
    assert not any("mission" in name for name in LiveMetrics("cloud").read())
    assert "cloudrc_mission_state" in LiveMetrics("teleop").read()
