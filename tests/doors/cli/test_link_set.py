# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link set`: settings become a profile, take effect, and are read back."""

import os
import stat
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from cloudrc.base.files import write_atomically
from cloudrc.base.outside.document import Document
from cloudrc.config.link_edit import edit_profile
from cloudrc.flight.local.places import link_socket
from cloudrc.flight.pod.link import make_profile_loader
from cloudrc.flight.pod.link_control import ControlServer
from cloudrc.link.follow import Profiles
from cloudrc.link.profile import summary
from cloudrc.link.state import LinkState, to_text
from cloudrc.results import under_way

CHANGES = [{"at_s": 9.0, "delay_ms": 50.0, "jitter_ms": 20.0}, {"at_s": 12.0, "loss": 0.1}]
TIMED = {"uplink": {"delay_ms": 40.0}, "downlink": {"delay_ms": 25.0, "changes": CHANGES}}


@pytest.mark.parametrize(
    ("settings", "way", "values", "notes"),
    [
        ("uplink.loss=0.02 link.uplink.delay_ms=60", "uplink", {"delay_ms": 60.0, "loss": 0.02},
         []),
        ("downlink.delay_ms=120", "downlink",
         {"delay_ms": 120.0, "changes": [{"at_s": 9.0, "jitter_ms": 20.0}, CHANGES[1]]},
         ["the schedule of the downlink no longer changes delay_ms"]),
    ],
)  # fmt: skip
def test_a_value_set_by_hand_stays_and_the_rest_goes_on(settings, way, values, notes):
    made = edit_profile(Document(deepcopy(TIMED)), None, settings.split())
    assert made.values[way] == values
    assert (made.cause, made.notes) == (settings.replace(" ", ", "), notes)
    assert not made.restart, "the schedule goes on where it is"


def test_a_delay_set_by_hand_ends_a_trace(tmp_path):
    (tmp_path / "t.csv").write_text("time_s,delay_ms\n0,40\n")
    traced = {"uplink": {"trace": str(tmp_path / "t.csv")}}
    made = edit_profile(Document(traced), None, ["uplink.delay_ms=20"])
    assert made.values["uplink"] == {"delay_ms": 20.0}
    assert made.notes == ["the uplink no longer follows its trace"]


def test_a_profile_takes_the_place_of_all_values():
    made = edit_profile(Document(deepcopy(TIMED)), "satellite", ["uplink.delay_ms=280"])
    assert made.values["uplink"]["delay_ms"] == 280.0
    assert made.values["downlink"]["queue_packets"] == 100
    assert (made.cause, made.restart) == ("profile satellite, uplink.delay_ms=280", True)
    assert "guard.command_age_max_ms=800" in made.notes[0]


class Way:
    """One direction of a local run, whose link applies each change at once."""

    def __init__(self, folder, way, url):
        folder.mkdir(parents=True)
        (folder / "map.yaml").write_text("{uplink: {delay_ms: 45}, downlink: {delay_ms: 45}}")
        load = make_profile_loader(way, folder / "none.yaml", 1)
        self.folder, self.profiles = folder, Profiles(folder / "map.yaml", load, print)
        self.deaf, self.state = False, None
        self.apply(self.profiles.first())
        self.server = ControlServer(link_socket(url, way), self.change, lambda: self.state)

    def change(self, document):
        loaded = self.profiles.take(document, self.folder)
        if not self.deaf:
            self.apply(loaded)
        return loaded.change.number

    def apply(self, loaded):
        values, change, asked = loaded.values, loaded.change, summary(loaded.direction)
        about = {"change": change.number, "cause": change.cause, "asked": asked}
        self.state = LinkState("relay", "", "relay", self.folder.name, values, "", 1, **about)
        write_atomically(self.folder / "link.json", to_text(self.state).encode())


@pytest.fixture
def flight(tmp_path):
    run = tmp_path / "runs" / "latest"
    with TemporaryDirectory(prefix="cloudrc-") as sockets:  # their paths are short
        url = f"unix:{sockets}/api.sock"
        ways = [Way(run / "link" / way, way, url) for way in ("uplink", "downlink")]
        with under_way.announced(run, url):
            yield ways
        for way in ways:
            way.server.shutdown()
            way.server.server_close()


@pytest.mark.usefixtures("flight")
def test_a_run_here_is_found_changed_and_read_back(call, as_json):
    shown = call("link set downlink.delay_ms=120 uplink.loss=0.02").out.splitlines()
    assert shown[1].split()[:4] == ["uplink", "relay", "45", "ms"]
    assert shown[2].split()[:4] == ["downlink", "relay", "120", "ms"]
    out = call("link set --profile handover").out
    assert "2 blackouts" in out, "what has no column of its own"
    downlink = as_json("link set --profile paper-p1")["links"]["downlink"]
    assert downlink["profile"]["downlink"]["delay_ms"] == 20.0
    assert downlink["cause"] == "profile paper-p1"
    assert "link set: uplink.loss: 1.5" in call("link set uplink.loss=1.5", code=2).err


def test_only_its_user_can_open_the_socket_of_a_link(flight):
    for way in flight:
        assert stat.S_IMODE(os.stat(way.server.server_address).st_mode) == 0o600


def test_a_link_that_does_not_answer_is_an_error(flight, monkeypatch, refused):
    flight[1].deaf = True
    monkeypatch.setattr("cloudrc.flight.pod.link_control.APPLY_LIMIT", 0.2)
    said = refused("link set downlink.delay_ms=120", code=4)
    assert "the downlink did not apply the change within" in said
    assert "see runs/latest/downlink.log" in said
    Path(flight[0].server.server_address).unlink()
    assert "the uplink does not answer (" in refused("link set downlink.delay_ms=120", code=4)
