"""Generated files are current; links, named files and cited sources exist."""

import ast
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
FOLDERS = "cloudrc", "charts", "tests", "tools"
ENTRY = re.compile(r"\bSource:(.*?)(?=\n\s*\n|\b(?:Source|Deviation):|\Z)", re.DOTALL)
PAGE = re.compile(r'([\w./-]+\.md)((?:, "[^"]+")*)')
VAGUE = re.compile(r"\bDESIGN\b|\b[Tt]he design\b|\b[Ff]ault F\d+")
PUBLIC = re.compile(
    r"\bRFC \d|[\w-]+\(\d\)|\bLinux, |\bKubernetes, |\bFoundationDB, |\bWireGuard, |\biproute2 "
    r"|\bYAML 1\.2|\bXDG Base Directory|\bIEEE conference template|\bthe authors' published code"
    r"|\bthe paper, (?:eqs?\. \(\d|[\w ]+ figure|network conditions)"
    r"|\b[A-Z]\. [A-Z]\w+.*\b(?:19|20)\d\d\b"  # an article or a book, with its year
)


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


# Sources in docstrings and comments


def entries(text, suffix):
    """Yield the sources in the docstrings and comments of a file, each on one line."""
    if "Source:" not in text:
        return
    comments = re.findall(
        r"<!--.*?-->" if suffix == ".xml" else r"(?:(?<!\S)#[^\n]*\n?[ \t]*)+", text, re.S
    )
    blocks = [re.sub(r"^[ \t]*#", "", comment, flags=re.MULTILINE) for comment in comments]
    if suffix == ".py":
        values = (node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr))
        blocks += [str(value.value) for value in values if isinstance(value, ast.Constant)]
    for block in blocks:
        yield from (" ".join(entry.split()) for entry in ENTRY.findall(block))


def unresolved(entry):
    """Return the parts of an entry that cannot be resolved."""
    found, pages = VAGUE.findall(entry), PAGE.findall(entry)
    for name, quoted in pages:
        headings = re.findall('"([^"]+)"', quoted)
        if (ROOT / name).is_file():
            text = (ROOT / name).read_text(encoding="utf-8")
            there = re.findall(r"^(?:#+|\|) +(.+?) *(?:\||$)", text, re.MULTILINE)
            found += [heading for heading in headings if heading not in there]
        if not headings or not (ROOT / name).is_file():
            found.append(name)
    return found if pages or PUBLIC.search(entry) else [*found, entry]


def test_every_source_resolves():
    paths = (path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.*")))
    files = [path for path in paths if path.suffix in {".py", ".yaml", ".xml"}]
    cited = [(path, entry) for path in files for entry in entries(path.read_text(), path.suffix)]
    assert cited
    wrong = [(str(path), found) for path, entry in cited if (found := unresolved(entry))]
    assert wrong == []
