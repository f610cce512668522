"""Text from files and from the API is escaped: it cannot control the terminal or fake a line."""

import json
from pathlib import Path

import pytest
import yaml

from cloudrc.cli import report
from cloudrc.cli.main import main
from cloudrc.cli.progress import FlightView
from cloudrc.errors import BadInputError
from cloudrc.record.writer import MISSING, McapWriter
from cloudrc.records import Fault
from cloudrc.teleop.client import Api
from cloudrc.teleop.store import Order
from cloudrc.text import table
from tests.cli.conftest import EVIL, SHOWN, assert_harmless
from tests.record.conftest import world_records
from tests.teleop.conftest import PLAN, running


@pytest.fixture
def printed(capsys):
    """Return a function that checks the output for the escaped text, and returns the output."""

    def check(count=None):
        said = "".join(capsys.readouterr())
        assert_harmless(said, count)
        return said

    return check


@pytest.mark.parametrize("words", ["run", "report", "recover", "link show"])
def test_a_name_in_an_error(words, printed):
    assert main([*words.split(), EVIL]) != 0
    (line,) = printed().splitlines()
    assert line.startswith("cloudrc: error: ")


def test_the_note_of_a_recording(folder, call):
    with McapWriter(folder / "a.mcap", clock="world") as writer:
        writer.write(world_records(5))
        writer.note({MISSING: EVIL})
    note = SHOWN.replace(r"\r", " ").replace(r"\n", " ")
    assert f"missing: {note}\n" in call("recover a.mcap").out


def test_what_is_printed_of_a_flight(printed):
    failures = [{"code": "x", "text": EVIL}] * 2
    found = {"verdict": "failure", "failures": failures, "numbers": {}}
    print(report.summary(found, Path(EVIL)))
    printed(count=4)
    with FlightView(1) as view:
        view.see([Fault(0, "bad", EVIL)])
    printed()
    print(table([["name", "value"], [EVIL, "1"]]))
    assert printed().count("\n") == 2


@pytest.fixture
def api():
    """An API with a stored mission whose name is EVIL, as an older teleop may have taken it."""
    with running(unix=True) as one:
        made = one.bridge.submit(lambda service, now_ns: service.create(Order(PLAN, EVIL), now_ns))
        made.result(10.0)
        yield one


def test_a_missions_name(api, printed, call):
    for words in ("list", "status", "status m1", "hold", "cancel"):
        main(["mission", *words.split(), "--api", api.url])
        printed()
    for form, read in (("json", json.loads), ("yaml", yaml.safe_load)):
        said = call(f"mission list --api {api.url} -o {form}").out
        assert [c for c in said if (c != "\n" and ord(c) < 32) or 127 <= ord(c) < 160] == []
        assert read(said)["missions"][0]["name"] == EVIL
    with pytest.raises(BadInputError) as refused:
        Api(api.url).post("/v1/missions", {EVIL: 2, "waypoints": [{"position_m": [99, 0, 1]}]})
    assert_harmless(str(refused.value))
