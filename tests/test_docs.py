"""Generated files are current; links and named files exist."""

import re
from pathlib import Path

import pytest

from cloudrc.record.topics import TOPICS
from tools import docs

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), ROOT / "charts" / "cloudrc" / "README.md"]
LINK = re.compile(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)")
OUTPUTS = docs.outputs()
FILE = re.compile(r"`([\w./*-]+(?:\.(?:py|yaml|md|svg)|/))`")


def anchors(page):
    """Return the anchors that GitHub makes from the headings of a page."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("path", OUTPUTS, ids=lambda path: path.name)
def test_a_generated_file_is_current(path):
    assert path.read_text() == OUTPUTS[path], "run: make docs"


def test_no_generated_file_is_left_over():
    assert docs.leftovers() == [], "run: make docs"
    assert docs.SAMPLING.keys() == TOPICS.keys()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for path, anchor in LINK.findall(text):
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"


def test_every_file_in_the_architecture_exists():
    named = FILE.findall((ROOT / "docs" / "architecture.md").read_text())
    assert named
    for name in named:
        assert any(ROOT.glob(name)) or any(ROOT.glob(f"cloudrc/{name}")), name


def test_the_list_of_pages_names_every_page():
    listed = {path for path, _ in LINK.findall((ROOT / "docs" / "README.md").read_text())}
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in ROOT.glob("docs/**/*.md")}
    assert pages - {"README.md"} <= listed
