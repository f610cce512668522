"""`cloudrc link set`: settings become a profile, take effect, and are read back."""

import json
from copy import deepcopy

import pytest

from cloudrc.config.document import Document
from cloudrc.config.load import edit_profile
from cloudrc.drivers import local
from cloudrc.errors import BadInputError
from cloudrc.files import write_atomically
from cloudrc.link.follow import HANDED_FILE, Profiles
from cloudrc.link.profile import summary
from cloudrc.link.state import LinkState, to_text
from cloudrc.processes.link import make_profile_loader
from cloudrc.runs import link_change

CHANGES = [{"at_s": 9.0, "delay_ms": 50.0, "jitter_ms": 20.0}, {"at_s": 12.0, "loss": 0.1}]
TIMED = {"uplink": {"delay_ms": 40.0}, "downlink": {"delay_ms": 25.0, "changes": CHANGES}}


@pytest.fixture
def traced(tmp_path):
    (tmp_path / "t.csv").write_text("time_s,delay_ms\n0,40\n")
    return {"uplink": {"trace": str(tmp_path / "t.csv")}}


@pytest.mark.parametrize(
    ("settings", "way", "values", "notes"),
    [
        ("uplink.loss=0.02 link.uplink.delay_ms=60", "uplink", {"delay_ms": 60.0, "loss": 0.02},
         []),
        ("uplink.loss=0.02", "downlink", TIMED["downlink"], []),
        ("uplink.loss=1", "uplink", {"delay_ms": 40.0, "loss": 1.0},
         ["the uplink loses 100 % of its packets: its loss is a share from 0 to 1, so 1 % is"
          " 0.01 (link.uplink.loss)"]),
        ("downlink.delay_ms=120", "downlink",
         {"delay_ms": 120.0, "changes": [{"at_s": 9.0, "jitter_ms": 20.0}, CHANGES[1]]},
         ["the time line of the downlink no longer changes delay_ms"]),
    ],
)  # fmt: skip
def test_a_value_set_by_hand_stays_and_the_rest_goes_on(settings, way, values, notes):
    made = edit_profile(Document(deepcopy(TIMED)), None, settings.split())
    assert made.values[way] == values
    assert (made.cause, made.notes) == (settings.replace(" ", ", "), notes)
    assert not made.restart, "the time line goes on where it is"


@pytest.mark.parametrize(
    ("setting", "value", "note"),
    [
        ("uplink.delay_ms=20", {"delay_ms": 20.0}, "the uplink no longer follows its trace"),
        ("uplink.loss=0.1", None,
         "if the trace of the uplink has a column loss, it still sets the loss"),
    ],
)  # fmt: skip
def test_a_delay_set_by_hand_ends_a_trace(setting, value, note, traced):
    made = edit_profile(Document(deepcopy(traced)), None, [setting])
    assert made.values["uplink"] == (value or {**traced["uplink"], "loss": 0.1})
    assert made.notes == [note]


def test_a_profile_takes_the_place_of_all_values():
    made = edit_profile(Document(deepcopy(TIMED)), "satellite", ["uplink.delay_ms=280"])
    assert made.values["uplink"]["delay_ms"] == 280.0
    assert made.values["downlink"]["queue_packets"] == 100
    assert (made.cause, made.restart) == ("profile satellite, uplink.delay_ms=280", True)
    assert "guard.command_age_max_ms=800" in made.notes[0]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ([], "nothing to set"),
        (["delay_ms=3"], "delay_ms: set a key of uplink or downlink"),
        (["uplink.delay=3"], "delay_ms"),
        (["uplink.loss=1.5"], "link set: uplink.loss: 1.5"),
    ],
)
def test_invalid_settings_are_refused(settings, words):
    with pytest.raises(BadInputError, match=words):
        edit_profile(Document(deepcopy(TIMED)), None, settings)


class Flight:
    """A local run whose link reads the change while the command waits."""

    def __init__(self, folder):
        self.links = {}
        for way in ("uplink", "downlink"):
            (own := folder / way).mkdir(parents=True)
            (own / "map.yaml").write_text("{uplink: {delay_ms: 45}, downlink: {delay_ms: 45}}")
            paths = own / "map.yaml", own / HANDED_FILE
            self.links[own] = Profiles(*paths, make_profile_loader(way, own / "none.yaml"), print)
            self.apply(own, self.links[own].first())

    def apply(self, own, loaded):
        (_, values, change), asked = loaded, summary(loaded.direction)
        about = {"change": change.number, "cause": change.cause, "asked": asked}
        state = LinkState("relay", "", "relay", own.name, values, "", 1, **about)
        write_atomically(own / "link.json", to_text(state).encode())

    def wait(self, _):
        for own, profiles in self.links.items():
            if loaded := profiles.poll():
                self.apply(own, loaded)


@pytest.fixture
def flight(tmp_path, monkeypatch):
    found = Flight(tmp_path / "runs" / "latest" / "link")
    monkeypatch.setattr(link_change, "sleep", found.wait)
    with local.announced(tmp_path / "runs" / "latest", ""):
        yield found


@pytest.mark.usefixtures("flight")
def test_a_run_here_is_found_changed_and_read_back(call):
    shown = call("link set downlink.delay_ms=120 uplink.loss=0.02").out.splitlines()
    assert shown[1].split()[:4] == ["uplink", "relay", "45", "ms"]
    assert shown[2].split()[:4] == ["downlink", "relay", "120", "ms"]
    out = call("link set --profile handover").out
    assert "2 blackouts" in out, "what has no column of its own"
    downlink = json.loads(call("link set --profile paper-p1 -o json").out)["links"]["downlink"]
    assert downlink["profile"]["downlink"]["delay_ms"] == 20.0
    assert downlink["cause"] == "profile paper-p1"


@pytest.mark.usefixtures("flight")
def test_a_link_that_does_not_answer_is_an_error(monkeypatch, refused):
    monkeypatch.setattr(link_change, "LOCAL_TIMEOUT", 0.0)
    monkeypatch.setattr(link_change, "sleep", lambda _: None)
    assert refused("link set downlink.delay_ms=120", code=4) == (
        "cloudrc: error: the uplink and downlink did not apply the change within 0 s; "
        "see runs/latest/uplink.log and runs/latest/downlink.log\n"
    )
