"""`cloudrc link set`: settings become a profile, take effect, and are read back."""

import json
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace

import pytest

from cloudrc.cli import link_set
from cloudrc.cli.main import main
from cloudrc.cli.processes import RelayControl
from cloudrc.config.document import Document
from cloudrc.config.load import edit_profile
from cloudrc.drivers import local
from cloudrc.errors import BadInputError
from cloudrc.link.follow import Loaded
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile

CHANGES = [{"at_s": 9.0, "delay_ms": 50.0, "jitter_ms": 20.0}, {"at_s": 12.0, "loss": 0.1}]
TIMED = {"uplink": {"delay_ms": 40.0}, "downlink": {"delay_ms": 25.0, "changes": CHANGES}}


def edit(before, *settings, profile=None):
    return edit_profile(Document(deepcopy(before)), profile, settings)


def test_a_value_set_by_hand_stays_and_the_rest_goes_on():
    made = edit(TIMED, "uplink.loss=0.02", "link.uplink.delay_ms=60")
    assert made.values["uplink"] == {"delay_ms": 60.0, "loss": 0.02}
    assert made.values["downlink"]["changes"] == CHANGES
    assert (made.cause, made.notes) == ("uplink.loss=0.02, link.uplink.delay_ms=60", [])
    assert not made.restart, "the time line goes on where it is"
    made = edit(TIMED, "downlink.delay_ms=120")
    assert made.values["downlink"]["changes"] == [{"at_s": 9.0, "jitter_ms": 20.0}, CHANGES[1]]
    assert made.notes == ["the time line of the downlink no longer changes delay_ms"]


def test_a_delay_set_by_hand_ends_a_trace(tmp_path):
    (tmp_path / "t.csv").write_text("time_s,delay_ms\n0,40\n")
    traced = {"uplink": {"trace": str(tmp_path / "t.csv")}}
    made = edit(traced, "uplink.delay_ms=20")
    assert made.values == {"uplink": {"delay_ms": 20.0}}
    assert made.notes == ["the uplink no longer follows its trace"]
    made = edit(traced, "uplink.loss=0.1")
    assert made.notes == ["if the trace of the uplink has a column loss, it still sets the loss"]


def test_a_profile_takes_the_place_of_all_values():
    made = edit(TIMED, "uplink.delay_ms=280", profile="satellite")
    assert made.values["uplink"]["delay_ms"] == 280.0
    assert made.values["downlink"]["queue_packets"] == 100
    assert (made.cause, made.restart) == ("profile satellite, uplink.delay_ms=280", True)
    assert "guard.command_age_max_ms=800" in made.notes[0]


def test_invalid_settings_are_refused():
    for settings, words in (
        ([], "nothing to set"),
        (["delay_ms=3"], "delay_ms: set a key of uplink or downlink"),
        (["uplink.delay=3"], "delay_ms"),
        (["uplink.loss=1.5"], "link set: uplink.loss: 1.5"),
    ):
        with pytest.raises(BadInputError, match=words):
            edit(TIMED, *settings)


class Flight:
    """A local run whose relay reads the change while the command waits."""

    def __init__(self, folder):
        direction, ways = DirectionProfile(0.045), ("uplink", "downlink")
        self.links = {way: LinkDirection(direction, 1, way == "uplink") for way in ways}
        first = {way: Loaded(direction, {way: {"delay_ms": 45.0} for way in ways}) for way in ways}
        folder.mkdir(parents=True)
        self.delays, self.folder = [], folder / "link"
        relay = SimpleNamespace(take_in=lambda: None, released=lambda way: {})
        note = lambda *noted: self.delays.append(noted)  # noqa: E731
        self.control = RelayControl(self.folder, self.links, first, note, relay)

    def wait(self, _):
        self.control.look()
        self.control.swap()

    def delay(self, way):
        """Return the one-way delay of a packet sent now [s]."""
        return self.links[way].send(1, 3, 0, 172, 0)[0] * 1e-9


@pytest.fixture
def flight(tmp_path, monkeypatch):
    found = Flight(tmp_path / "runs" / "latest")
    monkeypatch.setattr(link_set, "sleep", found.wait)
    with local.announced(tmp_path / "runs" / "latest"):
        yield found


def test_a_run_here_is_found_changed_and_read_back(flight, capsys):
    assert main(["link", "set", "downlink.delay_ms=120", "uplink.loss=0.02"]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[1].split()[:4] == ["uplink", "relay", "45", "ms"]
    assert shown[2].split()[:4] == ["downlink", "relay", "120", "ms"]
    assert (flight.delay("uplink"), flight.delay("downlink")) == pytest.approx((0.045, 0.120))
    assert flight.delays[-2:] == [("uplink", 0.045), ("downlink", 0.12)]
    assert main(["link", "set", "--profile", "handover"]) == 0
    assert "2 blackouts" in capsys.readouterr().out, "what has no column of its own"
    assert main(["link", "set", "--profile", "paper-p1", "-o", "json"]) == 0
    downlink = json.loads(capsys.readouterr().out)["links"]["downlink"]
    assert downlink["profile"]["downlink"]["delay_ms"] == 20.0
    assert (downlink["cause"], downlink["changes"]) == ("profile paper-p1", 3)


def test_a_relay_that_does_not_answer_is_an_error(flight, capsys, monkeypatch):
    monkeypatch.setattr(link_set, "LOCAL_TIMEOUT", 0.0)
    monkeypatch.setattr(link_set, "sleep", lambda _: None)
    assert main(["link", "set", "downlink.delay_ms=120"]) == 4
    assert capsys.readouterr().err == (
        "cloudrc: error: the uplink and downlink did not apply the change within 0 s; "
        f"see {Path('runs/latest/relay.log')}\n"
    )
