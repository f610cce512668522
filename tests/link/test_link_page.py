"""The page on the link names every key and action, and takes the bench's numbers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cloudrc.cli.link import ACTIONS
from cloudrc.cli.link_show import stream
from cloudrc.config.network import Direction
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.trace_sample import Numbers, numbers
from tools.paste_bench import BEGIN, END, pasted

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "link.md").read_text()


@pytest.mark.parametrize("key", Direction.model_fields)
def test_every_key_of_a_direction_has_its_row(key: str) -> None:
    assert f"| `{key}` |" in PAGE


@pytest.mark.parametrize("action", sorted(set(ACTIONS) - {"run"}))
def test_every_action_is_shown(action: str) -> None:
    assert f"cloudrc link {action} " in PAGE


def test_local_links_exist() -> None:
    targets = re.findall(r"\]\((?!https?:)([^)#]+)\)", PAGE)
    assert [target for target in targets if not (ROOT / "docs" / target).is_file()] == []


def test_a_bench_is_pasted_between_the_marks() -> None:
    page = pasted(PAGE, "\x1b[32mrelease error\x1b[0m  p50 9 us  \n")
    assert f"{BEGIN}\n```text\nrelease error  p50 9 us\n```\n{END}" in page
    assert pasted(page, "release error  p50 9 us") == page
    assert page.count(BEGIN) == 1
    assert page.endswith(PAGE[-200:])


def shown(profile: DirectionProfile, packets: int, rate: float = 100.0) -> Numbers:
    """The numbers of `cloudrc link show --packets N --rate HZ`, uplink."""
    return numbers(stream(profile, "uplink", 1, packets, rate))


def cells(heading: str) -> dict[str, list[float]]:
    """Every row of a table: its first cell, and the numbers in the others."""
    rows = PAGE.split(heading, 1)[1].split("\n\n", 1)[0].splitlines()[1:]
    table = [row.strip("| ").split("|") for row in rows]
    return {
        name.strip(" `"): [float(n) for n in re.findall(r"[\d.]+", " ".join(rest))]
        for name, *rest in table
        if "---" not in name
    }


@pytest.mark.parametrize(
    ("packets", "digits"), [(20_000, 8.0), pytest.param(300_000, 0.6, marks=pytest.mark.full)]
)
def test_the_tables_are_what_link_show_prints(packets: int, digits: float) -> None:
    """To so many units of the last digit."""
    for name, row in cells("| c | 0.3 | 0.5 | 0.7 | 0.9 |").items():
        for correlation, told in zip((0.3, 0.5, 0.7, 0.9), row, strict=True):
            profile = DirectionProfile(1.0, 0.01, name, correlation)  # type: ignore[arg-type]
            found = shown(profile, packets).correlation
            assert found == pytest.approx(told, abs=digits * 0.01), (name, correlation)
    for name, row in cells("| jitter | 50 Hz | 100 Hz | 200 Hz |").items():
        profile = DirectionProfile(0.07, float(name[2:4]) * 1e-3)
        for rate, told in zip((50.0, 100.0, 200.0), row, strict=True):
            found = 100.0 * shown(profile, packets, rate).overtaken
            assert found == pytest.approx(told, abs=digits), (name, rate)
    for name, row in cells("| at 100 Hz, 70 ms | free").items():
        for keep_order, told in ((False, row[:2]), (True, row[2:])):
            profile = DirectionProfile(0.07, float(name[2:4]) * 1e-3, keep_order=keep_order)
            both = shown(profile, packets)
            found_ms = [1e3 * both.mean, 1e3 * both.deviation]
            assert found_ms == pytest.approx(told, abs=digits * 0.1), (name, keep_order)


def test_the_numbers_of_the_page_have_their_command() -> None:
    assert "`cloudrc link show ./my.yaml --packets 300000`" in PAGE
