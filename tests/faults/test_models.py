"""The models of processes, clocks and teleop."""

from hypothesis import given
from hypothesis import strategies as st

from cloudrc.drivers.virtual import Clock
from cloudrc.faults.flight import FaultRun
from cloudrc.faults.schedule import FaultEvent, Schedule
from cloudrc.messages import GuardState


@given(st.integers(-(2**50), 2**50), st.integers(-500, 500), st.integers(0, 2**45))
def test_a_clock_reaches_a_time_exactly_when_it_says(offset_ns, drift_ppm, now_ns):
    clock = Clock(offset_ns, drift_ppm)
    when_ns = clock.when(clock.at(now_ns))
    assert when_ns <= now_ns
    assert clock.at(when_ns - 1) < clock.at(now_ns) <= clock.at(when_ns)


def test_teleop_pauses_and_its_successor_resumes():
    schedule = Schedule(3, "ideal", (FaultEvent("pod_shut_down", 8.0, 4.0, 0.25),))
    flight = FaultRun(schedule).fly(8.5)
    assert flight.events("paused")
    assert flight.guard_now()[0] is GuardState.HOLD
    flight.fly(9.5)
    assert (flight.teleop.service, flight.cloud.inner) == (None, None)
    assert flight.fly_mission().mission.state == "done"
