# SPDX-License-Identifier: Apache-2.0

"""`cloudrc up` and `cloudrc down`: a session flies missions, is steered, ends, and is reported."""

import json
import os
import re
import signal
import subprocess
import time
from contextlib import closing, contextmanager, suppress
from math import inf
from pathlib import Path

import pytest
from websockets.sync.client import connect

from cloudrc.config.load import load_experiment, read_experiment
from cloudrc.config.resolved import dump
from cloudrc.doors.cli import session
from cloudrc.flight.local import supervisor
from cloudrc.flight.machine import usable_cores
from cloudrc.flight.pod.realtime import free_ports
from cloudrc.results import under_way
from cloudrc.results.record.columns import Recording
from cloudrc.teleop.client import Api, ApiError
from cloudrc.teleop.store import Order, open_store
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.messages import Start
from cloudrc.wire.records import TelemetrySent
from tests.conftest import wait_until
from tests.flight.conftest import COMMAND, processes_of
from tests.results.record.conftest import cloud_records, world_records, write

USING = "cloudrc: using the run in s\n"


@pytest.fixture
def down(monkeypatch, call):
    """Return a function that runs `cloudrc down`, which ends no session; it returns the output."""
    monkeypatch.setattr(supervisor, "end_session", lambda run, limit: None)
    return lambda code, flags="": "".join(call(f"down {flags}", code=code))


def test_down_ends_sessions_only_and_asks_which(folder, down):
    assert "no session runs here; start one: cloudrc up;" in down(3)
    with under_way.announced(folder / "r", ""):
        assert "a flight of 'cloudrc run' ends by Ctrl-C there" in down(3)
        assert "--run r: no session runs there" in down(2, "--run r")
    (folder / "runs/latest").mkdir(parents=True)
    (folder / "runs/latest/uplink.log").touch()
    with under_way.announced(folder / "theirs", "", "session"):
        with under_way.announced(folder / "b", "", "session"):
            assert "2 runs are flying here; name one: --run b or --run theirs" in down(2)
        assert "runs/latest: has ended, or does not take this command; name" in down(2)
        assert "theirs: ended" in down(0, "--run theirs")


def drive_order():
    leg = Leg((0.0, 99.0, 0.35), tolerance=inf, dwell=0.0)  # beyond the fence
    return Order(Plan((leg,), Start.HERE, 3600.0, by_hand=True), "drive")


def test_down_tells_a_missing_report_from_no_mission(folder, down):
    with closing(open_store(folder / "missions.journal", b"")) as store:
        mission = store.add(drive_order())
    with under_way.announced(folder, "", "session"):
        assert "ended; no mission flew" in down(0)
        with closing(open_store(folder / "missions.journal", b"")) as store:
            store.note(store.find(mission.id), "started", "")
        assert "mission m1 flew, but has no report; to write it: cloudrc report" in down(1)


def test_a_killed_session_whose_recording_lacks_the_last_mission_has_no_report(folder, call):
    """The mission before the last one is not judged in its place."""
    with closing(open_store(folder / "missions.journal", b"")) as store:
        first, last = store.add(drive_order()), store.add(drive_order())
        for mission in (first, last):
            store.note(mission, "started", "")
    (folder / "config.yaml").write_text(dump(load_experiment("hover")))
    world = world_records(100)
    for at, record in enumerate(world):
        if isinstance(record, TelemetrySent):
            telemetry = record.telemetry._replace(mission_id=first.number)
            world[at] = record._replace(telemetry=telemetry)
    write(folder / "world.mcap", world, clock_id="a")
    write(folder / "cloud.mcap", cloud_records(100), "cloud", "a")
    shown = "".join(call(f"report {folder}", code=6))
    assert "the recording ends before mission m2, the last one, so there is no report" in shown
    assert read_experiment(folder / "config.yaml").name == "hover"
    assert not (folder / "mission.mcap").exists()


@pytest.fixture
def command(call, no_page):
    """Return a function that runs a command beside the session; it returns output and errors."""
    return lambda line, code=0: "".join(call(line, code=code))


@pytest.fixture
def said(folder):
    """Return what the session has said so far."""
    return (folder / "said").read_text


@pytest.fixture
def told(folder):
    """Return the report of the session."""
    return lambda: json.loads((folder / "s/report.json").read_text())


@contextmanager
def up(folder, *words):
    """Start a session in the folder `s`; yield its process once the robot waits for missions."""
    with (folder / "said").open("w") as said:
        process = subprocess.Popen(
            [*COMMAND, "up", "hover", "--out", "s", "--report", "none", *words],
            stdout=said,
            stderr=said,
        )
    try:
        text = (folder / "said").read_text
        wait_until(lambda: "to end: Ctrl-C here, or cloudrc down" in text())
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("settings", "proposed"),
    [
        (["world.scene=pipes", "mission=pipes"], ("pipes", "0.5 0 1.2")),
        (["world.robot=nano", "world.scene=empty"], ("MISSION.yaml", "0.5 0 1.2")),
        (["world.robot=rover", "world.scene=pillars", "mission=pillars"], ("pillars", "1 0")),
    ],
)
def test_a_session_proposes_what_fits_its_robot_and_scene(folder, settings, proposed):
    (folder / "config.yaml").write_text(dump(load_experiment("hover", settings)))
    assert session.propose(folder / "config.yaml") == proposed


@pytest.mark.process
@pytest.mark.alone
def test_a_session_flies_missions_and_reports_the_last_one(folder, command, said, told):
    began = time.monotonic()
    with up(folder) as process:
        busy = max(1.0, os.getloadavg()[0] / usable_cores())  # tests may share the machine
        assert time.monotonic() - began <= 5.0 * busy, "its address is told later"
        ports = re.findall(r"(\w+) :(\d+)", said())
        assert [name for name, _ in ports] == ["world", "cloud", "teleop", "uplink", "downlink"]
        wait_until(lambda: "guard GROUND" in command("mission status --run s"))
        (folder / "m.yaml").write_text("waypoints: [{position_m: [0.2, 0, 0.6]}]")
        assert "SUCCESS" in command("mission run m.yaml --run s")
        assert "s: on the way to (0.5, 0, 1.2); mission m2" in command("mission goto 0.5 0 1.2")
        wait_until(lambda: "done" in command("mission list --run s").splitlines()[-1])
        assert "s: in force after" in command("link set downlink.delay_ms=60")
        wait_until(lambda: "link: downlink 60 " in said())
        assert command("down") == f"s/report.json\n{USING}"
        assert process.wait(10) == 0
    assert said().splitlines()[-1] == "s/report.json"
    assert told()["verdict"] == "success"
    assert told()["numbers"]["waypoints_reached"]["value"] == 1
    flown = read_experiment(folder / "s/config.yaml")
    assert flown.description == "Mission m2 (goto), the last one of a session"
    assert flown.mission.waypoints[0].position_m == (0.5, 0.0, 1.2)
    assert len(Recording.read(folder / "s/mission.mcap")["/mission"]["event"]) == 3
    assert list(Recording.read(folder / "s/cloud.mcap")["/mission"]["event"]).count("done") == 2
    assert under_way.under_way() == {}


def sees(port, wanted):
    """Return whether a viewer that comes now gets messages of all wanted topics within 10 s.

    A viewer that comes while the topics begin may miss one: the server has lost its subscription.
    """
    topics, missing, until = {}, set(wanted), time.monotonic() + 10.0
    with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"]) as client:
        while missing and time.monotonic() < until:
            message = client.recv(timeout=20)
            if isinstance(message, bytes):  # operation, number of the subscription
                missing.discard(topics[int.from_bytes(message[1:5], "little")])
                continue
            for one in json.loads(message).get("channels", []):
                if one["topic"] not in missing:  # a slow client would miss the rare ones
                    continue
                topics[one["id"]] = one["topic"]
                asked = [{"id": one["id"], "channelId": one["id"]}]
                client.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
    return not missing


@pytest.mark.process
def test_foxglove_sees_the_flight(folder, said):
    (port,) = free_ports(1)
    topics = {"/tf", "/scene", "/guard", "/delay_estimate", "/uplink_delay"}
    with up(folder, "--foxglove", str(port)) as process:
        wait_until(lambda: f"foxglove: ws://127.0.0.1:{port}" in said())
        wait_until(lambda: sees(port, topics))
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


@pytest.mark.process
@pytest.mark.parametrize("ended", [True, False])
def test_a_session_that_ends_with_a_drive_has_its_report(folder, command, told, ended):
    with up(folder) as process:
        api = Api(under_way.under_way()[folder / "s"])
        for velocity in [(0.0, 0.0, 0.5)] * 30 + [(0.0, 0.0, 0.0)]:
            with suppress(ApiError):  # at first there is no telemetry
                api.post("/v1/drive", {"velocity_mps": velocity})
            time.sleep(0.1)
        wait_until(lambda: "next: the operator drives;" in command("mission status --run s"))
        if ended:
            command("mission resume --run s")
            wait_until(lambda: "SUCCESS" in command("mission list --run s"))
        assert command("down") == f"s/report.json\n{USING}"
        assert process.wait(10) == 0
    assert told()["verdict"] == ("success" if ended else "interrupted")
    assert (folder / "s/mission.mcap").exists()
    assert len((folder / "s/drive.csv").read_text().splitlines()) > 50
    command("report s", code=0 if ended else 130)
    command("run s/config.yaml --mode virtual --out again")


@pytest.mark.process
@pytest.mark.parametrize(("victim", "code"), [("cloud", 6), ("", -signal.SIGKILL)])
def test_a_session_that_dies_in_flight_can_be_reported(folder, command, said, told, victim, code):
    with up(folder) as process:
        command("mission goto 0.5 0 1.2")
        wait_until(lambda: "mission started" in said())
        time.sleep(1.0)
        pids = processes_of(process)
        os.kill(pids[victim] if victim else process.pid, signal.SIGKILL)
        assert process.wait(60) == code
        wait_until(lambda: under_way.under_way() == {}, 5.0)
        wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids.values()), 5.0)
    if victim:
        assert "the cloud process died in flight (signal 9)" in said()
    command("report s", code=130)  # interrupted
    numbers = told()["numbers"]
    assert numbers["rtt_mean"]["value"] > 0.04
    # Cloud's last messages died with it: what counts datagrams is left out.
    assert ("commands_applied" in numbers) == (not victim)
    (waypoint,) = read_experiment(folder / "s/config.yaml").mission.waypoints
    assert waypoint.position_m == (0.5, 0.0, 1.2)


@pytest.mark.process
def test_a_session_without_a_mission_has_no_report(folder, command):
    with up(folder) as process:
        assert "s: the session has not ended; end it: cloudrc down" in command("report s", code=2)
        assert command("down") == f"s: ended; no mission flew\n{USING}"
        assert process.wait(10) == 0
    assert "no mission flew, so there is no report" in command("report s", code=2)
