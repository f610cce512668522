# SPDX-License-Identifier: Apache-2.0

"""Every promise in docs/promises.md has a test, and every promise mark names a promise there."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_promises_and_their_marks_match():
    tests = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py"))
    page = (ROOT / "docs" / "promises.md").read_text(encoding="utf-8")
    table = page.partition("\n## Promises\n")[2].partition("\n## ")[0]
    names = re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE)
    assert len(names) == len(set(names)) > 0
    assert set(re.findall(r'pytest\.mark\.promise\("([a-z-]+)"\)', tests)) == set(names)
