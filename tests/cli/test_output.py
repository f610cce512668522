"""Output: aligned columns, readable numbers, colour only on request."""

from __future__ import annotations

import io
import json

import pytest
import yaml

from cloudrc.cli.main import main
from cloudrc.cli.output import format_number, is_live, paint, table


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")


def test_columns_line_up_and_numbers_are_right_aligned() -> None:
    assert table([("name", "value"), ("a", "1.5"), ("longer", "10.5")], right=[1]) == (
        "name    value\na         1.5\nlonger   10.5"
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.1474, "0.1474"), (26.96, "26.96"), (0.0, "0"), (1234.5, "1234"), (-3e-7, "-3.000e-07")],
)
def test_numbers_have_four_digits(value: float, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize("variable", ["NO_COLOR", "CI"])
def test_an_environment_variable_turns_colour_off(
    variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert paint("x", "red", Terminal()) == "\x1b[31mx\x1b[0m"
    monkeypatch.setenv(variable, "1")
    assert paint("x", "red", Terminal()) == "x"


def test_a_dumb_terminal_and_a_file_get_no_status_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_live(Terminal())
    assert not is_live(io.StringIO())
    monkeypatch.setenv("TERM", "dumb")
    assert not is_live(Terminal())


@pytest.mark.parametrize("line", [["list"], ["faults", "list"]])
def test_yaml_has_the_content_of_json(line: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    documents = []
    for form, read in (("json", json.loads), ("yaml", yaml.safe_load)):
        main([*line, "-o", form])
        documents.append(read(capsys.readouterr().out))
    assert documents[0] == documents[1]
    assert documents[0]["schemaVersion"] == 1
