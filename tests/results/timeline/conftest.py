# SPDX-License-Identifier: Apache-2.0

"""Flights of some seconds in virtual time, and recordings of their ends."""

from functools import cache

from cloudrc.config.load import load_experiment
from cloudrc.flight.virtual.flight import assemble
from cloudrc.results.record.merge import merge
from cloudrc.results.record.writer import McapWriter
from cloudrc.results.timeline.read import read_flight

MS = 1_000_000
CONSTANT = ("link.profile=ideal", "link.uplink.delay_ms=33", "link.downlink.delay_ms=21")
SETTINGS = {
    "constant": CONSTANT,
    "reordered": ("link.profile=paper-p3",),
    "in order of arrival": ("link.profile=paper-p3", "tunnel.order=arrival"),
    "blackouts": ("link.profile=lte", "link.both.blackouts=[{start_s: 1, duration_s: 0.3}]"),
    "computes": ("link.profile=lte", "cloud.compute_ms=7"),
    "waits at a bottleneck": ("link.profile=lte", "link.uplink.rate_kbit=300"),
    "radio": ("link.profile=5g-sa", "link.uplink.rate_kbit=900"),
    "plans": ("link.profile=wifi", "cloud.plan_s=0.3", "cloud.predictor=model_based"),
}


@cache
def records(*settings, experiment="hover", lasts_s=3):
    """Fly for `lasts_s`; return the records of world and of cloud."""
    experiment = load_experiment(experiment, settings)
    _, _, teleop, run = assemble(experiment)
    found = [], []

    def sink(*new):
        for records, more in zip(found, new, strict=True):
            records += more

    run.fly(lambda: teleop.over, lasts_s * 1000 * MS, sink)
    return found


def write(path, records, clock, clock_id="one"):
    """Write the file of an end."""
    with McapWriter(path, clock=clock, clock_id=clock_id) as writer:
        writer.write(records)
    return path


read_flights = {}


def flight_of(folder, *settings, **about):
    """Return a recorded flight as `_recorded` does; those alike are recorded once."""
    key = settings, *about.items()
    if key not in read_flights:
        read_flights[key] = _recorded(folder, *settings, **about)
    return read_flights[key]


def _recorded(folder, *settings, ahead_ns=0, **about):
    """Record a flight; cloud's clock is ahead of world's."""
    world, cloud = records(*settings, **about)
    write(folder / "world.mcap", world, "world")
    later = [each._replace(stamp_ns=each.stamp_ns + ahead_ns) for each in cloud]
    write(folder / "cloud.mcap", later, "cloud", "another" if ahead_ns else "one")
    merge(folder / "world.mcap", folder / "cloud.mcap").write(folder / "mission.mcap")
    return read_flight(folder)
