# SPDX-License-Identifier: Apache-2.0

"""A flight of which messages are lost: no number and no verdict says more than what is left."""

from dataclasses import replace

import numpy as np
import pytest

from cloudrc.flight.links.trace import one_way
from cloudrc.results.metrics.measure import IN_SPITE_OF_HOLES, SHIPPED, measure_all
from cloudrc.results.metrics.response import steps
from cloudrc.results.record.holes import END_NS, SOMEWHERE, Hole
from cloudrc.wire.records import Control
from tests.results.metrics.conftest import SECOND, at, flown, good, judged


def lossy(log, *spans, **options):
    """Return the flight of a log without the records of the spans of time [s]."""
    holes = [Hole(at(first), at(last)) for first, last in spans]
    log.keep(lambda stamp_ns: not any(b < stamp_ns < e for b, e in holes))
    flight = log.flight(**options)
    flight.recording.holes, flight.recording.told = tuple(holes), "damaged"
    return flight


@pytest.mark.parametrize(
    ("spans", "mission", "known"),
    [
        ([(4.0, 4.5), (12.0, 12.5)], {}, True),
        ([(9.5, 10.5)], {}, False),  # the end
        ([(5.0, 5.5)], {"waypoints": 2}, False),
        ([(7.5, 8.5)], {"touch": "board"}, False),
    ],
)
def test_an_incomplete_recording_proves_neither_success_nor_a_missed_goal(spans, mission, known):
    flight = lossy(good() if mission.get("touch") else flown(), *spans, **mission)
    verdict = judged(flight)
    assert verdict.outcome == "invalid"
    (failure,) = verdict.failures
    assert failure.code == "recording_incomplete"
    assert ("as far as the recording goes" in failure.text) == known


@pytest.mark.parametrize(("kills", "outcome"), [(1, "invalid"), (2, "success")])
def test_what_a_fault_has_lost_is_no_failure(kills, outcome):
    flight = lossy(flown(), (4.0, 4.5), (6.0, 6.5))
    assert judged(flight, kills=kills).outcome == outcome


def test_numbers_in_spite_of_a_hole_are_those_of_the_whole_flight():
    whole = measure_all(flown().flight())[0]
    found, notes, _ = measure_all(lossy(flown(), (5.0, 5.5)))
    assert found.keys() <= IN_SPITE_OF_HOLES <= SHIPPED.keys()
    assert {"duration", "age_of_information_mean", "waypoints_reached"} <= found.keys()
    assert not {"age_at_actuator_mean", "loss_uplink", "hold_count"} & found.keys()
    for name, number in found.items():
        assert number.value == pytest.approx(whole[name].value, rel=1e-3), name
    assert len(notes) == 1


def test_a_users_metric_is_not_measured_across_a_hole(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text('UNIT = "1"\ndef measure(flight):\n    return 1.0\n')
    assert "mine" in measure_all(flown().flight(), [str(path)])[0]
    found, notes, _ = measure_all(lossy(flown(), (5.0, 5.5)), [str(path)])
    assert "mine" not in found
    assert any(note.startswith("metric mine is not measured") for note in notes)


def stepping():
    """Return the log of a flight whose setpoint changes every 2 s."""
    log = flown()

    def setpoint(_, control):
        moved = (control.stamp_ns - at(0)) // (2 * SECOND)
        return control._replace(setpoint=(10.0 * (moved % 2), 5.0, 1.0))

    log.change(Control, setpoint)
    return log


def test_a_step_of_which_messages_are_lost_is_no_step():
    log = stepping()
    assert [round(each.start) for each in steps(log.flight())] == [0, 2, 4, 6, 8]
    assert [round(each.start) for each in steps(lossy(log, (3.8, 4.3)))] == [0, 6, 8]


def test_a_trace_has_no_loss_at_the_edges_of_a_hole():
    whole = one_way(flown().flight().recording, "uplink")
    found = one_way(lossy(flown(), (5.0, 5.5)).recording, "uplink")
    assert not np.isnan(found.delays).any()
    assert len(whole.delays) - 20 < len(found.delays) < len(whole.delays)
    assert any("0.50 s lost at 6.00 s" in note for note in found.notes)  # since the first packet


def test_a_recording_cut_short_is_measured_up_to_its_end():
    log = flown()
    log.keep(lambda stamp_ns: stamp_ns <= at(6))
    flight = log.flight()
    flight.recording.holes, flight.recording.lacking = (Hole(at(6), END_NS),), "cut short"
    assert "age_at_actuator_max" in measure_all(flight)[0]
    flight = replace(flight)
    flight.recording.holes = (SOMEWHERE,)
    assert measure_all(flight)[0] == {}
