"""Text from files is escaped: it cannot control the terminal or fake a line of output."""

import io
from pathlib import Path

import pytest
import yaml

from cloudrc.cli import report
from cloudrc.cli.link_verify import as_text, make_report
from cloudrc.cli.main import main
from cloudrc.cli.output import print_line, table
from cloudrc.cli.progress import FlightView
from cloudrc.link.verify.causes import Evidence, Findings
from cloudrc.link.verify.judge import Row
from cloudrc.record.writer import MISSING, McapWriter
from cloudrc.records import Fault
from tests.record.conftest import world_records

EVIL = "x\x1b]0;owned\x07\x9b2J\rcloudrc: all is well\n\u202ecloudrc: error: run me"
SHOWN = r"x\x1b]0;owned\x07\x9b2J\rcloudrc: all is well\n\u202ecloudrc: error: run me"


@pytest.fixture
def printed(capsys):
    """Return a function that checks the output for the escaped text, and returns the output."""

    def check():
        out, err = capsys.readouterr()
        assert_harmless(out + err)
        return out + err

    return check


def assert_harmless(text):
    assert SHOWN in text
    assert [c for c in text if not c.isprintable() and c != "\n"] == []
    assert [line for line in text.splitlines() if line.startswith("cloudrc: all")] == []


@pytest.mark.parametrize(
    "words",
    [["run"], ["report"], ["recover"], ["link", "show"], ["link", "verify"], ["faults", "run"]],
)
def test_a_name_in_an_error(words, printed):
    assert main([*words, EVIL]) != 0
    (line,) = printed().splitlines()
    assert line.startswith("cloudrc: error: ")


def test_names_in_an_error_of_several_lines(folder, printed):
    (folder / "a.yaml").write_text(yaml.safe_dump({EVIL: 1, "seed": EVIL}))
    assert main(["run", "./a.yaml"]) == 2
    head, *lines = printed().splitlines()
    assert head.endswith("a.yaml has 2 problems:")
    assert [line.startswith("  ./a.yaml:") for line in lines] == [True, True]


def test_the_note_of_a_recording(folder, capsys):
    with McapWriter(folder / "a.mcap", clock="world") as writer:
        writer.write(world_records(5))
        writer.note({MISSING: EVIL})
    assert main(["recover", "a.mcap"]) == 1
    note = SHOWN.replace(r"\r", " ").replace(r"\n", " ")
    assert f"lossy: {note}\n" in capsys.readouterr().out


def test_the_description_of_a_profile(folder, printed):
    (folder / "a.yaml").write_text(yaml.safe_dump({"description": EVIL, "uplink": {"delay_ms": 1}}))
    assert main(["link", "show", "./a.yaml", "--packets", "10", "-o", "a.svg"]) == 0
    assert printed().startswith(f"a: {SHOWN}\n")


def test_what_is_printed_of_a_flight(printed):
    failures = [{"code": "x", "text": EVIL}] * 2
    found = {"verdict": "failure", "failures": failures, "numbers": {}}
    print(report.summary(found, Path(EVIL)))
    assert printed().count(SHOWN) == 3
    stream = io.StringIO()
    FlightView(stream, 1).see([Fault(0, "bad", EVIL)])
    assert_harmless(stream.getvalue())
    print(table([["name", "value"], [EVIL, "1"]]))
    assert printed().count("\n") == 2
    print_line(EVIL)
    assert printed() == f"{SHOWN}\n"


def test_the_state_of_a_link_container():
    row = Row("mean", "s", 0.1, 0.1, 0.1, 0.1, "off")
    known = Evidence("none", elsewhere=(EVIL,))
    ways, probes = {"uplink": Findings([row], known)}, {"uplink": EVIL}
    text = as_text(make_report(EVIL, ways, probes))
    assert_harmless(text)
    assert text.count(SHOWN) == 3
