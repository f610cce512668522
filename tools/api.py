"""Compare the public Python API with an earlier commit: `make api`.

docs/api.md lists the public modules; in them, names without an underscore are public. After the
first release, a change that breaks a caller ends with exit code 1. Before, changes are only listed.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import griffe

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "api.md"


def public_modules(page: str) -> set[str]:
    """Return the modules in the first column of a table of docs/api.md."""
    return set(re.findall(r"^\| `(cloudrc(?:\.\w+)*)` \|", page, re.MULTILINE))


def last_release() -> str | None:
    """Return the newest tag such as v1.2.3 in this commit's history; None if there is none."""
    command = ["git", "describe", "--tags", "--abbrev=0", "--match", "v[0-9]*"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return found.stdout.strip() or None


def breaking_changes(
    before: griffe.Object | griffe.Alias, now: griffe.Object | griffe.Alias, modules: set[str]
) -> Iterator[str]:
    """Describe each difference between two packages that breaks a caller of `modules`."""
    for change in griffe.find_breaking_changes(before, now):
        # Upwards by parents: `module` of an imported name is where the name was defined.
        module = change.obj
        while module.kind is not griffe.Kind.MODULE and module.parent is not None:
            module = module.parent
        if module.path in modules:
            yield change.explain(griffe.ExplanationStyle.ONE_LINE)


def main() -> int:
    """Print the breaking changes since the commit in the first argument, or since the release."""
    release = last_release()
    base = sys.argv[1] if len(sys.argv) > 1 else release
    if base is None:
        print("no release yet: name a commit to compare with, such as 'make api SINCE=HEAD~10'")
        return 0
    before = griffe.load_git("cloudrc", ref=base, repo=ROOT)
    now = griffe.load("cloudrc", search_paths=[ROOT])
    found = list(breaking_changes(before, now, public_modules(PAGE.read_text())))
    print("\n".join(found) or f"the public API has no breaking change since {base}")
    return 1 if found and release else 0


if __name__ == "__main__":
    sys.exit(main())
