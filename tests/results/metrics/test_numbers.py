# SPDX-License-Identifier: Apache-2.0

"""Every shipped metric: numbers computed by hand, and its contract on any recording."""

from dataclasses import replace
from math import cos, hypot, isfinite, nan, radians, sin

import pytest

from cloudrc.config.schema import Criteria, MissionConfig, Waypoint
from cloudrc.physics.geometry.scene import load_scene
from cloudrc.results.metrics.descriptions import SCAN_STAGES
from cloudrc.results.metrics.flight import Flight
from cloudrc.results.metrics.measure import SHIPPED, measure_all
from cloudrc.results.metrics.mission import unconfirmed
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.topics import TOPICS
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import (
    Arrival,
    CommandApplied,
    Control,
    Counted,
    EnergyUsed,
    Fault,
    GroundTruth,
    GuardChange,
    Lateness,
    MissionEvent,
    PlanFollowed,
    TelemetrySent,
)
from tests.results.metrics.conftest import (
    ONE_PIPE,
    PELICAN,
    PERIOD,
    SECOND,
    START,
    at,
    flown,
    measured,
    paper,
    pressing,
    straight,
    straight_flight,
    to_point,
    touch,
)

WAYS = ("uplink", "downlink")
REAL_TIME = set(
    "real_time_factor world_slip world_lateness_p99 cloud_lateness_p99 missed_periods".split()
)
TRAFFIC = {f"{unit}_sent_{way}" for unit in ("packets", "bytes") for way in WAYS}
OF_RELAYS = {
    *(f"release_error_{share}_{way}" for share in ("p50", "p99", "p999") for way in WAYS),
    *(f"{name}_{way}" for name in ("relay_overflow", "relay_stalled") for way in WAYS),
    *(f"released_early_{way}" for way in WAYS),
}


def contact():
    log = flown()
    # Contacts of the floor, of a rotor, and later ones are not the tip's first touch.
    log.world += [touch(6, "floor"), touch(7, by_probe=False), touch(8), touch(9)]
    log.world.append(touch(3, "pipe_1", by_probe=False))
    pressing(log, 8, lambda n: 0.1 if n % 2 else 0.3)
    return log.flight(ONE_PIPE, touch="board")


def changed(kind, how):
    """Make a flight of which the n-th record of a class is replaced by `how(n, record)`."""
    log = flown()
    log.change(kind, how)
    return log.flight()


def plus(*records, waypoints=1):
    """Make a flight in which world recorded more."""
    log = flown()
    log.world += records
    return log.flight(waypoints=waypoints)


def echoes_at_once():
    """Each second telemetry waits in a queue: it arrives 39 ms late, just before the next one."""
    wait = 39_000_000
    return changed(
        Arrival,
        lambda n, a: a._replace(stamp_ns=a.stamp_ns + wait) if a.uplink and a.counter % 2 else a,
    )


def echoes_repeated():
    """Each command is echoed twice, the second time with 40 ms more in world."""
    log = flown()

    def repeat(sent):
        told, more = sent.telemetry, PERIOD * (sent.counter % 2)
        return {
            "echo_stamp_ns": told.echo_stamp_ns - more,
            "echo_hold_ns": told.echo_hold_ns + more,
        }

    log.tell(repeat)
    return log.flight()


def lost_late_and_duplicated():
    log = flown()
    log.change(Arrival, lambda n, a: a._replace(delay=0.08, used=False) if n % 4 == 1 else a)
    log.change(Arrival, lambda n, a: None if n % 2 == 0 else a)
    log.cloud += [record for record in log.cloud if isinstance(record, Arrival)]
    return log.flight()


HOLDS = [
    GuardChange(at(2.0), GuardState.HOLD, "command age"),
    GuardChange(at(3.5), GuardState.TRACK, "not the start"),
    GuardChange(at(9.5), GuardState.HOLD, "command age"),
]


def traffic():
    """World sends 100 datagrams per second, cloud 50; cloud restarts 6 s after the start."""
    totals = {
        ("world", "sent"): {0.5: 7, 9.5: 907},
        ("world", "sent_bytes"): {0.5: 0, 9.5: 180_000},
        ("cloud", "sent"): {0.5: 0, 5.5: 250, 6.5: 50, 9.5: 200},
        ("cloud", "sent_bytes"): {1.0: 3},
    }
    return plus(*(Counted(at(t), *of, n) for of, each in totals.items() for t, n in each.items()))


def planned():
    """All commands have plans, which begin 0.1 s early; their position is off at each odometry."""
    log = flown()
    log.change(CommandApplied, lambda n, c: c._replace(planned_ns=c.stamp_ns - SECOND // 10))
    for stamp in range(at(0.0), at(10.0), PERIOD):
        x, y, z = straight((stamp - START) / SECOND)
        log.cloud.append(PlanFollowed(stamp + PERIOD, stamp, (x + 0.003, y + 0.004, z)))
    log.cloud.append(PlanFollowed(at(5.0), at(5.0), (nan, 0.0, 0.0)))  # of a broken plug-in
    return log.flight()


def armed_early():
    """World arms the robot for mission 7 0.4 s before the first command, after mission 6."""
    log = flown()
    log.tell(lambda sent: {"mission_id": 7 if sent.stamp_ns >= at(-0.4) else 6})
    log.world.append(touch(8))
    return log.flight(touch="board")


def resting():
    log = flown(lambda t: (0.97, 0.0, 1.001))
    log.change(Control, lambda n, c: c._replace(setpoint=(1.0, 0.0, 1.0)))
    log.change(MissionEvent, lambda n, e: None if e.event == "done" else e)
    return log.flight()


def slow_machine():
    """World loses 0.5 s in 10 s; its wakes are 1 to 100 ms late, those of cloud half as much."""
    records = [Counted(at(n), "cloud", "missed_periods", 7 * n) for n in (1, 2)]
    for n in range(101):
        stamp, late = at(n / 10), (n or 1) * 1e-3
        slip = 3 * SECOND + (SECOND // 2 if n > 50 else 0)
        records.append(Lateness(stamp, "world", late, 1e-4, slip))
        records.append(Lateness(stamp, "cloud", late / 2, 1e-4, 0))
    return plus(*records)


def faults_and_drops():
    log = flown()
    # A repeated fault has one record, here before the mission, but it counts as often as its
    # counter rises in the flight. Cloud restarts before the last count.
    log.cloud += [Fault(START - PERIOD, "predictor_failed", "..."), Fault(at(1), "late", "...")]
    log.cloud += [Counted(at(n), "cloud", "predictor_failed", (7, 14, 2)[n]) for n in range(3)]
    log.world += [Counted(at(n), "world", "recorder_dropped", n) for n in (1, 2)]
    log.cloud += [Counted(at(n), "cloud", "recorder_dropped", 10 * n) for n in (1, 2)]
    log.cloud.append(Counted(at(2), "cloud", "controller_gaps", 3))
    log.cloud.append(Counted(at(2), "cloud", "horizon_clamped", 453))  # a limit, and no fault
    return log.flight()


OF_A_RELAY = [
    Counted(at(n), "link", f"uplink_{name}", total)
    for n, name, total in (
        (1.0, "release_error_p99_ns", 90_000),
        (2.0, "release_error_p99_ns", 40_000),
        (2.0, "released_early", 0),
        (2.0, "overflow", 3),
    )
]
REACHED = [MissionEvent(at(1 + n), "reached", w, "") for n, w in enumerate((0, 1, 1))]
REACHED.append(MissionEvent(at(3), "paused", 0, "a new teleop goes on"))


approx = pytest.approx
# On the axis the left rotor's upper rim is closest: .662 - |(.21 + .128, .05 + .0025)|.
ON_AXIS = 0.662 - hypot(0.338, 0.0525)
NUMBERS = {
    straight_flight: {
        "duration": 10.0,
        "start_delay": 0.0,
        "waypoints_reached": 1.0,
        "speed_max": 1.0,
        "distance_flown": 10.0,  # 10 s at 1 m/s
        "prediction_error_rms": 0.005,  # off by (3, 4, 0) mm
        # Applied 90 ms after the measurement, predicted for 80 ms after it: 10 mm along x.
        "estimate_error_rms": hypot(0.013, 0.004),
        "delay_estimate_error_rms": 0.01,
        "tracking_rms_measured": 0.5,  # the setpoint is (0.3, 0.4, 0) m away
        "tracking_rms_estimated": hypot(0.3 - 0.09 - 0.003, 0.4 - 0.004),
        "rtt_mean": 0.09,
        "rtt_p95": 0.09,
        "loop_delay_mean": 0.13,  # with the 40 ms in world
        "delay_sample_mean": 0.13,
        "uplink_delay_mean": 0.05,
        "downlink_delay_mean": 0.04,
        "age_of_information_mean": 0.05,
        # Applied 90 ms after the measurement, in use for 40 ms.
        "age_at_actuator_mean": 0.11,
        "age_at_actuator_p99": 0.1296,
        **dict.fromkeys(("age_at_actuator_max", "peak_age_mean"), 0.13),
        "age_violation": None,  # without a limit
        "misses_in_10": 0.0,
        "commands_applied": 251.0,  # 25 per second for 10 s, both ends included
        # The HOLD after the mission's end does not count.
        **dict.fromkeys(("hold_count", "hold_time", "fault_count", "obstacle_contacts"), 0.0),
        **{f"{name}_{way}": 0.0 for name in ("loss", "late") for way in WAYS},
        # No board contact, no pipe, no rest, no real time, no relay.
        **dict.fromkeys(("contact_time", "touch_speed", "steady_contact_force", "contact_impulse")),
        **dict.fromkeys(("peak_contact_force", "min_clearance", "min_clearance_flight")),
        **dict.fromkeys(("steady_error_x", "recorder_dropped", "controller_gaps")),
        "rotor_energy": None,
        "control_cost": 2.225,  # 10 s, (0.25, 0.4, 0) m from the setpoint
        **dict.fromkeys(REAL_TIME | OF_RELAYS | TRAFFIC),
    },
    contact: {
        "contact_time": 8.0,
        "touch_speed": 0.15,
        "peak_contact_force": 10.3,
        "contact_impulse": approx(0.02, abs=3e-3),  # 0.2 N over 0.1 s
        "steady_contact_force": approx(0.2, abs=3e-3),
        "obstacle_contacts": 1.0,
    },
    # The pipe is from x = 2 m to 7 m. Just before it the robot's front is inside it, with the rotor
    # at y = .21 + .1.
    lambda: flown(lambda t: (t, 0.1 if t < 2 else 0.0, 1.0)).flight(ONE_PIPE, touch="board"): {
        "min_clearance": ON_AXIS,
        "min_clearance_flight": approx(ON_AXIS - 0.1, abs=0.05),
        "obstacle_contacts": 0.0,
    },
    # 2 W from 1 s before the flight to 5 s after it.
    lambda: plus(EnergyUsed(at(-1.0), 5.0), EnergyUsed(at(15.0), 37.0)): {"rotor_energy": 20.0},
    lambda: plus(*REACHED, waypoints=2): {"waypoints_reached": 2.0, "duration": 10.0},
    echoes_at_once: {
        "rtt_mean": approx(0.1095, abs=1e-4),
        "rtt_p95": 0.129,
        "loop_delay_mean": approx(0.1495, abs=1e-4),
    },
    echoes_repeated: {"rtt_mean": 0.09, "loop_delay_mean": 0.13},
    # A duplicate does not hide a loss; late datagrams count in the delay.
    lost_late_and_duplicated: {
        "loss_uplink": approx(0.5, abs=6e-3),
        "late_uplink": approx(0.5, abs=6e-3),
        "uplink_delay_mean": approx(0.065, abs=1e-3),
    },
    lambda: changed(Arrival, lambda n, arrival: arrival._replace(delay=nan)): {
        **{f"{way}_delay_mean": None for way in WAYS},
        "age_of_information_mean": None,
        "rtt_mean": 0.09,
    },
    # Time zero stays the first TRACK. The holds last 1.5 s, and 0.5 s to the end.
    lambda: plus(*HOLDS): {"hold_count": 2.0, "hold_time": 2.0, "duration": 10.0},
    traffic: {
        "packets_sent_uplink": 1000.0,
        "bytes_sent_uplink": 200_000.0,
        "packets_sent_downlink": 500.0,
        "bytes_sent_downlink": None,
    },
    planned: {
        "prediction_error_rms": 0.005,  # off by (3, 4, 0) mm
        "delay_estimate_error_rms": None,
        "estimate_error_rms": hypot(0.013, 0.004),
    },
    armed_early: {
        "duration": 10.4,  # the mission began with the telemetry of -0.4 s
        "contact_time": 8.4,
        "start_delay": 0.4,
        "speed_max": 1.0,
        "commands_applied": 251.0,  # the flight begins with TRACK
    },
    resting: {
        "steady_error_x": 0.03,
        "steady_error_y": 0.0,
        "steady_error_z": 0.001,
        "duration": 15.0,  # without an end it lasts as its recording
    },
    slow_machine: {
        "world_slip": 0.5,
        "real_time_factor": 10 / 10.5,
        "world_lateness_p99": 0.099,
        "cloud_lateness_p99": 0.0495,
        "missed_periods": 14.0,
    },
    faults_and_drops: {"fault_count": 10.0, "recorder_dropped": 22.0, "controller_gaps": 3.0},
    lambda: plus(*OF_A_RELAY): {
        "release_error_p99_uplink": 40e-6,
        "released_early_uplink": 0.0,
        "relay_overflow_uplink": 3.0,
        "relay_overflow_downlink": None,
    },
}


@pytest.mark.parametrize(("fly", "expected"), NUMBERS.items())
def test_numbers(fly, expected):
    flight = fly()
    expected = {k: approx(v) if isinstance(v, float) else v for k, v in expected.items()}
    assert {name: measured(flight, name) for name in expected} == expected


def flight_of(recording):
    return Flight(recording, Criteria(), paper()[0].mission, load_scene("pipes"), PELICAN)


def test_the_paper_flight_has_all_numbers_of_virtual_flight():
    numbers, notes, _ = measure_all(flight_of(paper()[1]))
    assert (notes, list(numbers)) == ([], sorted(numbers))
    resting = {f"steady_error_{axis}" for axis in "xyz"}
    others = {"recorder_dropped", "final_error", "controller_gaps", "yaw_error", "age_violation"}
    others |= {
        "commands_withheld",
        "seen_dropped",
        "seen_to_acted",
        "seen_to_acted_p99",
        "seen_to_acted_max",
    }
    others |= {"frames_shown", "frame_psnr", "video_kbit", "frames_late"}
    others |= {f"frame_age_{name}" for name in ("mean", "p99", "max")}
    others |= {"out_of_view", "bearing_error_rms"}
    waits = [f"{way}_{name}" for way in WAYS for name in ("cell", "rate", "grant", "repeat")]
    others |= {f"budget_{name}" for name in ("compute", "uplink_request", *waits, *SCAN_STAGES)}
    assert set(SHIPPED) - set(numbers) == REAL_TIME | OF_RELAYS | resting | others
    for name, number in numbers.items():
        assert set(number.unit) <= set("smNJB12^/ "), name
        assert number.meaning[0].isupper(), name
        assert number.meaning.endswith("."), name
        assert isfinite(number.value), name


def test_an_empty_recording_has_no_numbers():
    assert measure_all(flight_of(Recording.from_records([]))) == ({}, [], "")


@pytest.mark.parametrize(("degree", "reached"), [(90, 1.0), (86, 1.0), (84, 0.0), (-90, 0.0)])
def test_a_waypoint_with_a_yaw_needs_the_true_yaw_too(degree, reached):
    half = radians(degree) / 2

    def turned(odometry):
        return odometry._replace(orientation_wxyz=(cos(half), 0.0, 0.0, sin(half)))

    log = flown()
    log.change(GroundTruth, lambda _, row: row._replace(odometry=turned(row.odometry)))
    log.tell(lambda sent: {"odometry": turned(sent.telemetry.odometry)})
    flight = log.flight(mission=to_point(10.0, 10.0, yaw_deg=90.0))
    assert measured(flight, "waypoints_reached") == reached
    assert measured(flight, "yaw_error") == pytest.approx(abs(radians(90 - degree)))


NOTHING = Recording.from_records([])


@pytest.mark.parametrize("lost", sorted(TOPICS))
def test_a_missing_topic_makes_no_metric_fail(lost):
    recording = replace(straight_flight().recording)
    recording._tables[lost] = NOTHING[lost]
    assert measure_all(Flight(recording, Criteria(), MissionConfig(), ONE_PIPE, PELICAN))[1] == []


@pytest.mark.parametrize(
    ("x", "tolerance", "dwell", "reached"),
    [
        (9.0, 0.53, 1.0, 1.0),
        (9.0, 0.53, 1.1, 0.0),
        (10.5, 0.4, 0.0, 0.0),
        (10.3, 0.3, 0.0, 1.0),  # 10.3 - 10.0 is above 0.3 in floating point
    ],
)
def test_a_waypoint_counts_if_the_true_position_confirms_it(x, tolerance, dwell, reached):
    """The operator reports it at 10 s; the robot flies at 1 m/s along x."""
    flight = flown().flight(mission=to_point(x, tolerance, dwell))
    assert measured(flight, "waypoints_reached") == reached


@pytest.mark.parametrize(
    ("stalled", "reached"),
    [(9.5, 1.0), (8.0, 0.0)],  # 8.0: the stall was over before
)
def test_the_dwell_time_counts_on_the_operators_clock(stalled, reached):
    """The robot is near for 1 s of world's clock, which loses 0.2 s at `stalled` [s]."""
    log = flown()
    log.tell(lambda sent: {"slip_ns": 200_000_000 * (sent.stamp_ns >= at(stalled))})
    flight = log.flight(mission=to_point(9.5, 0.5, 1.2))
    assert measured(flight, "waypoints_reached") == reached
    assert bool(unconfirmed(flight)) == (not reached)


@pytest.mark.parametrize(("noise", "reached"), [(0.16, 0.0), (0.18, 1.0)])
def test_the_noise_of_the_measured_positions_is_added_to_the_tolerance(noise, reached):
    """The robot ends .5 m from the waypoint; a noise of .18 m in x alone has an rms of .104 m."""

    def shake(sent):
        odometry = sent.telemetry.odometry
        x, y, z = odometry.position
        x += noise if sent.counter % 2 else -noise
        return {"odometry": odometry._replace(position=(x, y, z))}

    log = flown()
    log.tell(shake)
    flight = log.flight(mission=to_point(10.5, 0.2))
    assert measured(flight, "waypoints_reached") == reached


def test_the_first_telemetry_of_a_session_may_be_that_of_its_first_mission():
    log = flown()
    log.change(TelemetrySent, lambda _, sent: sent if sent.stamp_ns >= at(-0.4) else None)
    log.tell(lambda sent: {"mission_id": 7})
    flight = log.flight()
    assert measured(flight, "start_delay") == approx(0.4)
    assert measured(flight, "duration") == approx(10.4)


def test_the_cross_track_error_is_the_distance_from_the_nearest_line_until_the_touch():
    x, y, z = straight(0)
    corners = [Waypoint(position_m=(x + way, y + 0.4, z)) for way in (0.0, 20.0)]
    mission = MissionConfig(waypoints=tuple(corners))
    flight = flown().flight(mission=mission)
    assert measured(flight, "cross_track_rms") == approx(0.4, abs=0.01), "but in the first 0.4 s"
    log = flown()
    log.world.append(touch(0.2))
    touched = log.flight(mission=mission, touch="board")
    assert measured(touched, "cross_track_rms") == approx(0.2 / 3**0.5, abs=0.01)
