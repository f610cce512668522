# SPDX-License-Identifier: Apache-2.0

"""The blocks of code in the pages of docs, and the commands in them.

A reader saves the files of a page, and types its blocks of `bash` and `sh`. A comment in front of a
block, `<!-- test: MARK -->`, says what is special:

- `NAME` without a blank, such as `law.py`: the block is this file. A block whose first line is
  `# law.py` needs no mark.
- `needs ...`, such as `needs a GPU`: tests do not type the block. `NEEDS` finds the common needs,
  such as a cluster, without a mark; the tests that have it type the block.
- `files of PAGE`, anywhere: the reader has the files of this other page, too.
- `first terminal`, `other numbers`: see tests/tutorials.py.
"""

import re
import runpy
import shlex
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
BLOCK = re.compile(
    r"^(?: *<!-- test: ([^\n]+) -->\n)?( *)```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL
)
SHELL = ("bash", "sh")
FILES_OF = re.compile("<!-- test: files of (.+) -->")
NAMED = re.compile(r"# ([\w.]+\.\w+)\n")
NEEDS = {
    "a cluster": "^(kubectl|helm|kind|make|docker) |^cloudrc .* (--cluster|--release|--on|-n) ",
    "ROS": r"\bros2?\b",
    "namespaces": r"^cloudrc link exec ",
    "a session": r"^cloudrc (up|down|console|mission|replay|link (set|relay)|policy serve)\b",
    "another program": r"^(?!(cloudrc|cd|mkdir|pip|python|head|kubectl|helm|kind|make|docker) )",
}
"""What a line needs that not every test has -> how it looks."""


class Block(NamedTuple):
    """A block of code of a page; without a mark and a language these are empty."""

    mark: str
    language: str
    body: str

    @property
    def lines(self):
        """Return the lines that a reader types; one that ends in a backslash goes on."""
        return [line for line in self.body.replace("\\\n", "").splitlines() if line]

    @property
    def needs(self):
        """Return what the block needs beside cloudrc; nothing if everybody can type it."""
        found = {
            what
            for what, look in NEEDS.items()
            if any(re.search(look, f"{line.partition(' #')[0]} ") for line in self.lines)
        }
        mark = re.match("needs (.*)", self.mark)
        return found | {mark[1]} if mark else found

    @property
    def file(self):
        """Return the name of the file that the block is, or nothing."""
        named = NAMED.match(self.body)
        if self.mark and " " not in self.mark:
            return self.mark
        return named[1] if named and self.language not in SHELL else ""


def blocks_of(page):
    """Return the blocks of a page of the repository, such as docs/gym.md, without its indent."""
    return [
        Block(mark, language, re.sub(f"^{indent}", "", body, flags=re.MULTILINE))
        for mark, indent, language, body in BLOCK.findall((ROOT / page).read_text("utf-8"))
    ]


def files_of(page):
    """Return the files that a reader of a page has: name -> text."""
    others = FILES_OF.findall((ROOT / page).read_text("utf-8"))
    found = {}
    for each in [*(f"docs/{other}" for other in others), page]:
        found |= {block.file: block.body for block in blocks_of(each) if block.file}
    return found


def commands_of(line):
    """Split a line of a shell into its commands, each a list of words, without its comment."""
    lexer = shlex.shlex(line.removeprefix("$ "), posix=True, punctuation_chars=True)
    lexer.whitespace_split, lexer.commenters = True, ""
    words = []
    for word in lexer:
        if word.startswith("#"):
            break
        words.append(word)
    parts = groupby(words, lambda word: not set(word) - {*"();<>|&"})
    return [[*part] for is_operator, part in parts if not is_operator]


def blocks(page, language):
    """Return the texts of a page's blocks, such as of gym, that are in a language."""
    return [each.body for each in blocks_of(f"docs/{page}.md") if each.language == language]


def run_page(page, folder):
    """Run the Python blocks of a page as one program; return it."""
    program = folder / "page.py"
    program.write_text(code := "\n".join(blocks(page, "python")))
    runpy.run_path(str(program))
    return code
