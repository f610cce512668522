"""The page on the link names every key and action, and takes the bench's numbers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cloudrc.cli.link import ACTIONS
from cloudrc.config.network import Direction
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
