# SPDX-License-Identifier: Apache-2.0

"""Generated files are current; links and named files exist."""

import re
from pathlib import Path
from typing import get_args

import pytest

from cloudrc.results.metrics.verdict import FailureCode
from cloudrc.results.record.topics import TOPICS
from tests.support.commands import python
from tools import docs
from tools.site import contents, dead_links, prepare, relinked, write_plain
from tools.words import lines

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("charts/**/*.md")]
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
    assert docs.leftovers(OUTPUTS) == [], "run: make docs"
    assert docs.SAMPLING.keys() == TOPICS.keys()


def test_each_failure_code_is_explained_once():
    page = (ROOT / "docs" / "verdict.md").read_text()
    cells = re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
    assert sorted(re.findall(r"\w+", " ".join(cells))) == sorted(get_args(FailureCode))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for path, anchor in LINK.findall(text):
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"


def test_the_words_of_each_door_can_be_counted():
    """Each page that its reader reads is there, up to a heading that exists."""
    counted = [line for line in lines() if "first own result" in line]
    assert [line.partition(":")[0] for line in counted] == [*contents()][1:6]


def test_every_file_in_the_architecture_exists():
    named = FILE.findall((ROOT / "docs" / "architecture.md").read_text())
    assert named
    for name in named:
        assert any(ROOT.glob(name)) or any(ROOT.glob(f"cloudrc/{name}")), name


def test_the_tour_names_what_exists_and_follows_a_packet():
    page = (ROOT / "CONTRIBUTING.md").read_text()
    stops = re.findall(r"^\| \d+ \| `([\w/]+\.py)`: (.+?) \|", page, re.MULTILINE)
    assert len(stops) == 10
    for file, names in stops:
        text = (ROOT / "cloudrc" / file).read_text()
        for name in re.findall(r"(\w+)`", names):
            assert re.search(rf"\bdef {name}\(|^{name} = ", text, re.MULTILINE), (file, name)
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    said = re.findall(r": (\S+) ms after", python("-c", block, check=True).stdout)
    assert 0.0 < float(said[0]) < float(said[1]) < float(said[2])


def test_the_list_of_pages_names_every_page_once():
    listed = [source for pages in contents().values() for source, _ in pages]
    pages = {path.relative_to(ROOT).as_posix() for path in PAGES}
    assert sorted(listed) == sorted(pages - {"README.md", "docs/README.md"})


def test_an_assistant_gets_a_list_of_all_pages_and_each_as_markdown(tmp_path):
    prepare(tmp_path / "pages")
    write_plain(tmp_path / "pages", tmp_path / "site")
    listed = LINK.findall((tmp_path / "site" / "llms.txt").read_text())
    assert len(listed) == len(PAGES) - 1  # not the list itself
    assert all((tmp_path / "site" / name).is_file() for name, _ in listed)


@pytest.mark.parametrize(
    ("link", "there"),
    [
        ("../CHANGELOG.md", "changelog.md"),
        ("link.md#traps", "link.md#traps"),
        ("../examples/fork.py", "source/examples/fork.py.md"),
        ("https://example.org/a.md", "https://example.org/a.md"),
    ],
)
def test_a_link_of_a_page_leads_to_a_page_of_the_site(link, there):
    code = "\n```\n[a](b.md)\n```\n"
    assert relinked("docs/gym.md", f"[x]({link}){code}") == f"[x]({there}){code}"


def test_a_dead_link_of_the_site_is_named(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "index.html").write_text('<h2 id="head"></h2><a href="../#no"></a>')
    alive = (
        '<a href="there/#head"></a><a href="https://example.org/"></a><a href="#own" id="own"></a>'
    )
    dead = '<a href="gone/"></a><img src="gone.png">'
    (tmp_path / "index.html").write_text(alive + dead)
    found = ["index.html: gone.png", "index.html: gone/", "there/index.html: ../#no"]
    assert sorted(dead_links(tmp_path)) == found
