"""What `make bench-link` prints comes in, its section of docs/link.md goes out.

usage: make bench-link | python tools/paste_bench.py
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "link.md"
BEGIN, END = "<!-- bench-link: begin -->", "<!-- bench-link: end -->"
SECTION = re.compile(f"{BEGIN}.*?{END}", re.DOTALL)
COLOUR = re.compile(r"\x1b\[[0-9;]*m")


def pasted(page: str, output: str) -> str:
    """Put a bench's output into the page, as it was printed."""
    lines = [COLOUR.sub("", line).rstrip() for line in output.strip().splitlines()]
    block = "\n".join([BEGIN, "```text", *lines, "```", END])
    text, count = SECTION.subn(lambda _: block, page)
    if count != 1:
        raise ValueError(f"the page has {count} sections for the bench; give it one")
    return text


if __name__ == "__main__":
    printed = sys.stdin.read()
    if not printed.strip():
        sys.exit("paste_bench: nothing came in; run: make bench-link | python tools/paste_bench.py")
    PAGE.write_text(pasted(PAGE.read_text(encoding="utf-8"), printed), encoding="utf-8")
