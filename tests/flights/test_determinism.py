# SPDX-License-Identifier: Apache-2.0

"""The same experiment and seed give identical records, on any wall clock."""

import gc
import os
import re
import weakref
from collections import Counter
from pathlib import Path

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.flight.assembly.cloud import build_cloud
from cloudrc.flight.assembly.link import build_links
from cloudrc.flight.assembly.world import build_world
from cloudrc.flight.virtual.flight import assemble, start_mission
from cloudrc.flight.virtual.run import VirtualRun
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.wire.tunnel.codec import DecodeError
from cloudrc.wire.tunnel.end import Identity
from tests.flights.conftest import both_ways, ring, sha256
from tests.support.commands import python

SHORT = ("mission.waypoints=[{position_m: [0.5, 0, 0.7], dwell_s: 1.0}]", "mission.touch=null")
ROOT = Path(__file__).resolve().parents[2]
PACKAGE = sorted((ROOT / "cloudrc").rglob("*.py"))
PRINT = """
from tests.flights.conftest import sha256
from tests.flights.test_determinism import short
print(sha256(short()))
"""


def short(*settings):
    return load_experiment("paper", (*SHORT, *settings))


@pytest.mark.promise("one-seed-one-run")
def test_the_same_seed_gives_the_same_records_in_any_process():
    env = os.environ | {"PYTHONHASHSEED": "77", "PYTHONPATH": str(ROOT)}
    printed = python("-c", PRINT, env=env, check=True).stdout
    first, again, other = map(sha256, (short(), short(), short("seed=2")))
    assert printed.strip() == first == again != other


PLAN = ("cloud.predictor=model_based", "cloud.estimator=earliest", "cloud.plan_s=0.4")


@pytest.mark.parametrize(
    "settings",
    [
        *((f"link.profile={name}",) for name in ("paper-p2", "lossy")),
        ("link.profile=lte", *PLAN),
    ],
)
def test_objects_and_encrypted_bytes_make_the_same_records(settings):
    experiment, identity = short(*settings), Identity(bytes(16), bytes(16), ring())
    world, teleop = build_world(experiment, identity), start_mission(experiment)
    cloud = build_cloud(experiment, identity, teleop)
    run, records = VirtualRun(world, cloud, *build_links(experiment)), RecordStore()
    run.fly(lambda: teleop.over, 150_000_000_000, records.add)
    assert Recording(records=records).sha256 == sha256(experiment)


def watch_damage(link, session):
    """Count how `session` answers the datagrams that `link` damages: the refusal, or "opened".

    Return the counts, and the set of the damaged datagrams.
    """
    outcomes, damaged, corrupt, verify = Counter(), set(), link.corrupted, session.open

    def corrupted(epoch, kind, counter, data):
        arrives = corrupt(epoch, kind, counter, data)
        damaged.update({arrives} - {data})
        return arrives

    def opened(data):
        try:
            found = verify(data)
        except DecodeError as error:
            outcomes[str(error)] += data in damaged
            raise
        outcomes["opened"] += data in damaged
        return found

    link.corrupted, session.open = corrupted, opened
    return outcomes, damaged


def test_both_ends_refuse_every_damaged_datagram_in_virtual_time():
    damaging = both_ways(corrupt=0.3)
    world, cloud, _, run = assemble(load_experiment("hover", ["link.profile=ideal", *damaging]))
    ways = ((run._downlink, world), (run._uplink, cloud))
    seen = [watch_damage(link, end._session) for link, end in ways]
    run.fly(lambda: False, 3_000_000_000, lambda of_world, of_cloud: None)
    for (_, end), (outcomes, damaged) in zip(ways, seen, strict=True):
        assert outcomes.total() == len(damaged) > 70
        assert outcomes["opened"] == 0
        assert end.counts["tag"] == outcomes["tag"] > 0.7 * outcomes.total(), "else in the header"
        assert end.counts["used"] > 200


WALL = re.compile(
    r"\btime\.(time|time_ns|localtime|gmtime|ctime|strftime|CLOCK_REALTIME)\b"
    r"|from time import|\bdate(time)?\.(now|utcnow|today)\b"
)
"""What reads a wall clock."""
CONTROL_PATH = (
    *("world/", "cloud/", "teleop/", "wire/", "link/"),
    *("flight/assembly/", "flight/local/", "flight/pod/", "flight/virtual/"),
)
ALLOWED = {
    # The kernel stamps datagrams and probes by this clock; only ages of 0 to 50 ms are used.
    *("link/carry/udp.py", "link/verify/probe.py"),
    # Only people read these times.
    *("flight/pod/ends.py", "flight/pod/process.py", "link/follow.py"),
}


@pytest.mark.promise("wall-clock-does-not-matter")
def test_nothing_on_the_control_path_reads_a_wall_clock():
    for code in ("time.time()", "from time import time_ns", "datetime.date.today()"):
        assert WALL.search(code)
    assert not WALL.search("time.monotonic()")
    places = {path.relative_to(ROOT / "cloudrc").as_posix(): path for path in PACKAGE}
    mine = {place: path for place, path in places.items() if place.startswith(CONTROL_PATH)}
    assert len(mine) > 60
    assert {place for place, path in mine.items() if WALL.search(path.read_text())} == ALLOWED


@pytest.mark.parametrize("name", ["hover", "gap"])
def test_a_flight_goes_with_its_last_name_because_a_sweep_collects_no_garbage(name):
    run = assemble(load_experiment(name))[3]
    run.advance(1_000_000_000)
    ends = [weakref.ref(run), weakref.ref(run._world), weakref.ref(run._cloud)]
    gc.disable()
    try:
        del run
        assert [end() for end in ends] == [None] * 3
    finally:
        gc.enable()
