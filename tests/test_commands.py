# SPDX-License-Identifier: Apache-2.0

"""Every command that a page prints is one that cloudrc takes, and those that can be typed work."""

import re

import pytest

from cloudrc.doors.cli.parser import build_parser
from cloudrc.flight.experiment import load
from tests.conftest import nightly
from tests.support.pages import ROOT, SHELL, blocks_of, commands_of
from tests.test_docs import PAGES
from tests.tutorials import Reader

NAMES = [path.relative_to(ROOT).as_posix() for path in PAGES]
ELSEWHERE = {
    "README.md": "tests/test_readme.py",
    "docs/robot.md": "tests/robots/test_page.py",
    **dict.fromkeys((n for n in NAMES if "/tutorials/" in n), "tests/test_tutorials.py"),
}
"""Page -> the test that types its commands."""
PLAYED = [
    name
    for name in NAMES
    if name not in ELSEWHERE
    and any(block.language in SHELL and not block.needs for block in blocks_of(name))
]
COMMAND = re.compile(r"^ *(?:\$ )?cloudrc [a-z]")
"""A line with a command; a block without a language, or with an answer, has other lines, too."""
OWN_FILE = re.compile(r"/|\.(yaml|csv|txt)\b")
"""A file of the reader, without which the keys of an experiment cannot be checked."""


def printed(page):
    """Return the words of each command of cloudrc in the blocks of a page."""
    found = []
    for block in blocks_of(page):
        if block.language not in ("python", "yaml"):
            lines = [line for line in block.lines if COMMAND.match(line)]
            found += [words for line in lines for words in commands_of(line)]
    return [words[1:] for words in found if words[0] == "cloudrc"]


def parsed(words):
    """Parse a command as cloudrc does; a variable of the shell is 1."""
    words = [re.sub(r"\$\w+", "1", word) for word in words]
    return build_parser([words[0]]).parse_args(words)


@pytest.mark.parametrize("page", [name for name in NAMES if printed(name)])
def test_cloudrc_takes_every_command_of_a_page(page):
    for words in printed(page):
        options = parsed(words)
        if words[0] in ("run", "up") and not OWN_FILE.search(" ".join(words)):
            load(options.experiment, options.set, options.seed, fleets=True)


@pytest.mark.process
@pytest.mark.parametrize("page", nightly(*PLAYED))
def test_the_commands_of_a_page_work(page, tmp_path):
    for name in ("docs", "examples"):  # what a clone has
        (tmp_path / name).symlink_to(ROOT / name)
    Reader(tmp_path).play(page, compares=False)
