# SPDX-License-Identifier: Apache-2.0

"""Prepare the pages of the site, and look for dead links in the finished site: `make site`.

`python -m tools.site pages FOLDER` copies the repository's pages into a folder. In the repository
they link to each other as GitHub shows them; the copies link to pages of the site. Files outside of
docs/ to which a page links become pages, too. The pages of commands and of Python get what argparse
and docstrings say.

`python -m tools.site plain PAGES SITE` puts the pages as Markdown into the finished site, and their
list for assistants, llms.txt (https://llmstxt.org).

`python -m tools.site check FOLDER` ends with 1 if a link in a finished site leads nowhere.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import SplitResult, unquote, urlsplit

from cloudrc.doors.cli.parser import COMMANDS, Parser, build_parser
from tools.api import PAGE, public_names

ROOT = Path(__file__).resolve().parents[1]
NAMES = {
    **{path.name: path.name.lower() for path in ROOT.glob("*.md")},
    "README.md": "index.md",
    "docs/README.md": "pages.md",
    "charts/cloudrc/README.md": "chart.md",
    "charts/cloudrc/UPGRADING.md": "upgrading.md",
}
"""Page of the repository -> page of the site, where it is not that below docs/."""
FENCE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(\]\()(?!https?:|#)([^)#\s]+)")
LISTED = re.compile(r"^- (.*\]\([^)]*\))(?:: (.*))?$", re.MULTILINE)
"""A line of docs/README.md: one or more pages, and what their titles do not say."""


def prepare(folder: Path) -> None:
    """Write all pages of the site as Markdown, and the files beside them."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "docs", folder)
    (folder / "README.md").unlink()
    sources = [path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/**/*.md")]
    waiting = {*sources, *NAMES}
    done: set[str] = set()
    while waiting:
        source = waiting.pop()
        done.add(source)
        name = site_name(source)
        if name.endswith(".md"):
            text = read(source)
            waiting |= set(links(source, text)) - done
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(relinked(source, text), encoding="utf-8")


def site_name(source: str) -> str:
    """Return the name in the site of a file of the repository."""
    if source in NAMES:
        return NAMES[source]
    return source.removeprefix("docs/") if source.startswith("docs/") else f"source/{source}.md"


def read(source: str) -> str:
    """Return the text of a page; other files, and folders, are shown as code."""
    path = ROOT / source
    if path.suffix == ".md":
        return path.read_text("utf-8") + GENERATED.get(source, str)()
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    blocks = [f"```{each.suffix[1:]}\n{each.read_text('utf-8')}```\n" for each in files]
    return "\n".join([f"# {source}\n", *blocks])


def links(source: str, text: str) -> Iterator[str]:
    """Yield the files of the repository to which a page links."""
    for part in FENCE.split(text)[::2]:
        for _, target in LINK.findall(part):
            yield os.path.normpath(Path(source).parent / target)


def relinked(source: str, text: str) -> str:
    """Let the links of a page lead to pages of the site."""
    here = Path(site_name(source)).parent

    def replace(found: re.Match[str]) -> str:
        target = site_name(os.path.normpath(Path(source).parent / found[2]))
        return found[1] + os.path.relpath(target, here)

    parts = FENCE.split(text)
    parts[::2] = [LINK.sub(replace, part) for part in parts[::2]]
    return "".join(parts)


def contents() -> dict[str, list[tuple[str, str]]]:
    """Read docs/README.md: heading -> its pages, each a file and what its title does not say."""
    parts = re.split("^## (.*)\n", (ROOT / "docs" / "README.md").read_text("utf-8"), flags=re.M)
    return {
        head: [
            (path, about)
            for cell, about in LISTED.findall(text)
            for path in links("docs/README.md", cell)
        ]
        for head, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def write_plain(pages: Path, site: Path) -> None:
    """Copy the prepared pages into the finished site, and write their list for assistants."""
    for page in pages.rglob("*.md"):
        copy = site / page.relative_to(pages)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(page, copy)
    blocks = ["# cloudrc\n", f"> {described()}\n"]
    for head, listed in {
        "First": [("README.md", "what cloudrc is, and the first minute")],
        **contents(),
    }.items():
        rows = (
            f"- [{title(source)}]({site_name(source)}){about and f': {about}'}\n"
            for source, about in listed
        )
        blocks.append(f"## {head}\n\n{''.join(rows)}")
    (site / "llms.txt").write_text("\n".join(blocks), encoding="utf-8")


def described() -> str:
    """Return the sentence that describes the site."""
    settings = (ROOT / "mkdocs.yml").read_text("utf-8")
    return re.findall("^site_description: (.*)$", settings, re.MULTILINE)[0]


def title(source: str) -> str:
    """Return the first heading of a page."""
    return (ROOT / source).read_text("utf-8").partition("# ")[2].partition("\n")[0]


def commands() -> str:
    """Write the help of each command and of its verbs."""
    return "".join(_helps(build_parser(COMMANDS), "## cloudrc"))


def _helps(parser: Parser, heading: str) -> Iterator[str]:
    """Yield the help of each command of a parser, and of the verbs below it."""
    for name, each in parser.verbs.items():
        yield f"\n{heading} {name}\n\n```text\n{each.format_help()}```\n"
        yield from _helps(each, f"#{heading} {name}")


def python() -> str:
    """Write a directive of mkdocstrings for each public name."""
    return "".join(f"\n::: {name}\n" for name in sorted(public_names(PAGE.read_text("utf-8"))))


GENERATED = {"docs/reference/cli.md": commands, "docs/reference/python.md": python}
"""Page -> what the site's page has behind its text."""


class Page(HTMLParser):
    """The ids of a built page, and what it links to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids, self.links = {""}, set[str]()
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect ids and links of one tag."""
        found = dict(attrs)
        self.ids.add(found.get("id") or "")
        if tag != "link":
            self.links |= {found.get("href") or "", found.get("src") or ""}


def dead_links(site: Path) -> Iterator[str]:
    """Yield each link within a built site that leads to no page, file or heading of it."""
    pages = {path: Page(path) for path in site.rglob("*.html") if path.name != "404.html"}
    for path, page in pages.items():
        for link in map(urlsplit, page.links):
            if not link.scheme and not link.netloc and is_dead(path, link, pages):
                yield f"{path.relative_to(site)}: {link.geturl()}"


def is_dead(path: Path, link: SplitResult, pages: Mapping[Path, Page]) -> bool:
    """Tell whether a link on the page `path` leads nowhere."""
    target = Path(os.path.normpath(path.parent / unquote(link.path))) if link.path else path
    target = target / "index.html" if target.is_dir() else target
    if target in pages:
        return unquote(link.fragment) not in pages[target].ids
    return not target.is_file()


def main(what: str, folder: str, site: str = "") -> int:
    """Do what the command line asks for."""
    if what == "pages":
        prepare(Path(folder))
        return 0
    if what == "plain":
        write_plain(Path(folder), Path(site))
        return 0
    dead = sorted(dead_links(Path(folder)))
    print("\n".join(dead) or f"{folder}: no dead link")
    return bool(dead)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
