"""Every metric on a synthetic flight, with numbers computed by hand."""

from __future__ import annotations

from math import hypot, nan

import pytest

from cloudrc.messages import GuardState
from cloudrc.metrics import SHIPPED, Flight
from cloudrc.records import Arrival, Control, Counted, Fault, GuardChange, Lateness, MissionEvent
from tests.metrics.conftest import (
    DONE,
    ONE_PIPE,
    PERIOD,
    SECOND,
    START,
    at,
    flown,
    pressing,
    straight_flight,
    touch,
)


def measured(name: str, flight: Flight) -> float | None:
    return SHIPPED[name].measure(flight)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("duration", 10.0),
        ("waypoints_reached", 1.0),
        ("speed_max", 1.0),
        ("distance_flown", 10.0),  # 10 s at 1 m/s
        ("prediction_error_rms", 0.005),  # off by (3, 4, 0) mm where the command is applied
        # Applied 90 ms after the measurement, predicted for 80 ms after it: 10 mm more along x.
        ("estimate_error_rms", hypot(0.013, 0.004)),
        ("delay_estimate_error_rms", 0.01),
        ("tracking_rms_measured", 0.5),  # the setpoint is (0.3, 0.4, 0) m from the measurement
        ("tracking_rms_estimated", hypot(0.3 - 0.09 - 0.003, 0.4 - 0.004)),
        ("rtt_mean", 0.09),
        ("rtt_p95", 0.09),
        ("loop_delay_mean", 0.095),
        ("uplink_delay_mean", 0.05),
        ("downlink_delay_mean", 0.04),
        ("loss_uplink", 0.0),
        ("loss_downlink", 0.0),
        ("late_uplink", 0.0),
        ("late_downlink", 0.0),
        ("age_of_information_mean", 0.05),
        ("commands_applied", 251.0),  # 25 per second for 10 s, both ends included
        ("hold_count", 0.0),  # the HOLD after the mission's end does not count
        ("hold_time", 0.0),
        ("fault_count", 0.0),
    ],
)
def test_straight_flight(name: str, expected: float) -> None:
    assert measured(name, straight_flight()) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    "name",
    [
        "contact_time",
        "tip_speed",
        "steady_contact_force",
        "peak_contact_force",
        "min_clearance",
        "min_clearance_flight",
        "pipe_contacts",
        "steady_error_x",
        "real_time_factor",
        "world_slip",
        "world_lateness_p99",
        "cloud_lateness_p99",
        "recorder_dropped",
    ],
)
def test_unknown_numbers_are_absent(name: str) -> None:
    """The flight has no board contact, no pipe, no rest and no real time."""
    assert measured(name, straight_flight()) is None


def test_contact() -> None:
    log = flown()
    # Contacts of the floor, of a rotor, and later ones are not the tip's first touch.
    log.world += [touch(6, "floor"), touch(7, tip=False), touch(8), touch(9)]
    pressing(log, 8, lambda n: 0.1 if n % 2 else 0.3)
    flight = log.flight(ONE_PIPE, contact=True)
    assert measured("contact_time", flight) == pytest.approx(8.0)
    assert measured("tip_speed", flight) == pytest.approx(0.15)
    assert measured("peak_contact_force", flight) == pytest.approx(0.3)
    assert measured("steady_contact_force", flight) == pytest.approx(0.2, abs=3e-3)


def test_steady_force_needs_two_seconds_and_a_completed_mission() -> None:
    late = flown()
    late.world.append(touch(9))
    assert measured("steady_contact_force", late.flight(ONE_PIPE)) is None
    cancelled = flown()
    cancelled.world.append(touch(2))
    cancelled.change(
        MissionEvent, lambda n, event: event._replace(event="cancelled") if n == 2 else event
    )
    assert measured("steady_contact_force", cancelled.flight(ONE_PIPE)) is None


def test_clearance_inside_and_outside() -> None:
    """The pipe is from x = 2 m to 7 m; before it the robot flies 10 cm beside the axis."""
    log = flown(lambda t: (t, 0.1 if t < 2 else 0.0, 1.0))
    flight = log.flight(ONE_PIPE)
    # On the axis the left rotor's upper rim is closest: .662 - |(.21 + .128, .05 + .0025)|.
    on_axis = 0.662 - hypot(0.338, 0.0525)
    assert measured("min_clearance", flight) == pytest.approx(on_axis, abs=1e-9)
    # Just before the pipe the robot's front is inside it, with the rotor at y = .21 + .1.
    assert 0.2 < measured("min_clearance_flight", flight) < on_axis - 0.05


def test_pipe_contacts_are_counted() -> None:
    log = flown()
    log.world += [touch(3, "pipe_1"), touch(4, "pipe_1", tip=False), touch(5, "board")]
    assert measured("pipe_contacts", log.flight(ONE_PIPE)) == 2.0
    assert measured("pipe_contacts", flown().flight(ONE_PIPE)) == 0.0


def test_a_waypoint_counts_once() -> None:
    log = flown()
    log.cloud += [MissionEvent(at(1 + n), "reached", w, "") for n, w in enumerate((0, 1, 1))]
    assert measured("waypoints_reached", log.flight(waypoints=2)) == 2.0


def test_a_pause_does_not_end_the_flight() -> None:
    """A new process of teleop continues a mission that the old one has paused."""
    log = flown()
    log.cloud.append(MissionEvent(at(3), "paused", 0, "paused by shutdown"))
    assert log.flight().end_ns == DONE


def test_a_repeated_echo_counts_once() -> None:
    """The first echo fills half of the flight's 251 periods, but it is one of two echoes."""
    log = flown()

    def silent(n: int, control: Control) -> Control:
        rtt = 0.1 if control.stamp_ns <= at(5) else 0.3
        return control._replace(rtt=rtt, loop_delay=rtt)

    log.change(Control, silent)
    assert measured("rtt_mean", log.flight()) == pytest.approx(0.2)
    assert measured("rtt_p95", log.flight()) == pytest.approx(0.29)
    assert measured("loop_delay_mean", log.flight()) == pytest.approx(0.2)


def test_loss_and_lateness() -> None:
    log = flown()
    log.change(Arrival, lambda n, arrival: None if n % 10 == 0 else arrival)
    log.change(Arrival, lambda n, arrival: arrival._replace(used=n % 3 != 0))
    for way in ("uplink", "downlink"):
        assert measured(f"loss_{way}", log.flight()) == pytest.approx(0.1, abs=6e-3)
        assert measured(f"late_{way}", log.flight()) == pytest.approx(1 / 3, abs=6e-3)


def test_a_duplicate_does_not_hide_a_loss() -> None:
    log = flown()
    log.change(Arrival, lambda n, arrival: None if n % 2 == 0 else arrival)
    log.cloud += [record for record in log.cloud if isinstance(record, Arrival)]
    assert measured("loss_uplink", log.flight()) == pytest.approx(0.5, abs=6e-3)


def test_late_datagrams_count_in_the_delay() -> None:
    log = flown()
    log.change(
        Arrival,
        lambda n, a: a._replace(delay=0.08, used=False) if n % 2 else a._replace(delay=0.02),
    )
    assert measured("uplink_delay_mean", log.flight()) == pytest.approx(0.05, abs=1e-4)


def test_without_a_shared_clock_one_way_numbers_are_absent() -> None:
    log = flown()
    log.change(Arrival, lambda n, arrival: arrival._replace(delay=nan))
    for name in ("uplink_delay_mean", "downlink_delay_mean", "age_of_information_mean"):
        assert measured(name, log.flight()) is None
    assert measured("rtt_mean", log.flight()) == pytest.approx(0.09)


def test_holds() -> None:
    log = flown()
    log.world += [
        GuardChange(at(2.0), GuardState.HOLD, "command age"),
        GuardChange(at(3.5), GuardState.TRACK, "fresh command"),
        GuardChange(at(9.5), GuardState.HOLD, "command age"),
    ]
    assert measured("hold_count", log.flight()) == 2.0
    assert measured("hold_time", log.flight()) == pytest.approx(2.0)  # 1.5 s, and 0.5 s to the end


def test_hover() -> None:
    log = flown(lambda t: (0.97, 0.0, 1.001))
    log.change(Control, lambda n, control: control._replace(setpoint=(1.0, 0.0, 1.0)))
    log.change(MissionEvent, lambda n, e: None if e.event == "done" else e)
    assert measured("steady_error_x", log.flight()) == pytest.approx(0.03)
    assert measured("steady_error_y", log.flight()) == pytest.approx(0.0)
    assert measured("steady_error_z", log.flight()) == pytest.approx(0.001)


@pytest.mark.parametrize("why", ["moved", "touched", "short"])
def test_a_robot_not_at_rest_has_no_steady_error(why: str) -> None:
    log = flown(lambda t: (0.97, 0.0, 1.0))
    log.change(
        Control,
        lambda n, c: c._replace(setpoint=(float(why == "moved" and c.stamp_ns < at(5)), 0.0, 1.0)),
    )
    if why != "short":
        log.change(MissionEvent, lambda n, e: None if e.event == "done" else e)
    if why == "touched":
        pressing(log, 14, lambda n: 0.2)
    assert measured("steady_error_x", log.flight()) is None


def test_real_time() -> None:
    """World loses 0.5 s in 10 s; its wakes are 1 to 100 ms late, those of cloud half as much."""
    log = flown()
    for n in range(101):
        stamp, late = at(n / 10), (n or 1) * 1e-3
        slip = 3 * SECOND + (SECOND // 2 if n > 50 else 0)
        log.world.append(Lateness(stamp, "world", late, 1e-4, slip))
        log.cloud.append(Lateness(stamp, "cloud", late / 2, 1e-4, 0))
    flight = log.flight()
    assert measured("world_slip", flight) == pytest.approx(0.5)
    assert measured("real_time_factor", flight) == pytest.approx(10 / 10.5)
    assert measured("world_lateness_p99", flight) == pytest.approx(0.099)
    assert measured("cloud_lateness_p99", flight) == pytest.approx(0.0495)


def test_faults_and_drops() -> None:
    log = flown()
    # A repeated fault has one record, here before the mission, but its count includes each time.
    log.cloud += [Fault(START - PERIOD, "predictor_failed", "..."), Fault(at(1), "late", "...")]
    log.cloud += [Counted(at(n), "cloud", "predictor_failed", 7 * n) for n in (1, 2)]
    log.world += [Counted(at(n), "world", "recorder_dropped", n) for n in (1, 2)]
    log.cloud += [Counted(at(n), "cloud", "recorder_dropped", 10 * n) for n in (1, 2)]
    assert measured("fault_count", log.flight()) == 15.0
    assert measured("recorder_dropped", log.flight()) == 22.0


def test_time_zero_is_the_first_track() -> None:
    log = flown()
    log.world.append(GuardChange(at(4), GuardState.TRACK, "fresh command again"))
    assert log.flight().start_ns == START


def test_the_relays_counts_become_numbers() -> None:
    log = flown()
    assert measured("release_error_p99_uplink", log.flight()) is None
    log.world += [
        Counted(at(n), "link", f"uplink_{name}", total)
        for n, name, total in (
            (1.0, "release_error_p99_ns", 90_000),
            (2.0, "release_error_p99_ns", 40_000),
            (2.0, "released_early", 0),
            (2.0, "overflow", 3),
        )
    ]
    flight = log.flight()
    assert measured("release_error_p99_uplink", flight) == pytest.approx(40e-6)
    assert measured("released_early_uplink", flight) == 0.0
    assert measured("relay_overflow_uplink", flight) == 3.0
    assert measured("relay_overflow_downlink", flight) is None
