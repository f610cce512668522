"""Write the registry of a release's images into the chart, before wheel and chart are built.

The workflow `release` runs this. In a clone the registry stays empty, because the images that `make
images` builds are in none.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def set_registry(chart: Path, registry: str) -> None:
    """Set `registry`, such as ghcr.io/me, in values, README and examples of the folder `chart`."""
    _replace(chart / "values.yaml", '\n  registry: ""\n', f"\n  registry: {registry}\n")
    row = '| `image.registry` | `"{}"` |'
    _replace(chart / "README.md", row.format(""), row.format(registry))
    for job in sorted((chart / "examples").glob("*.yaml")):
        if " image: cloudrc/" in job.read_text("utf-8"):
            _replace(job, " image: cloudrc/", f" image: {registry}/cloudrc/")


def _replace(path: Path, old: str, new: str) -> None:
    """Replace the only `old` in a file, which must be there."""
    text = path.read_text("utf-8")
    if text.count(old) != 1:
        sys.exit(f"{path}: has {text.count(old)} times {old!r}, not once")
    path.write_text(text.replace(old, new), "utf-8")


if __name__ == "__main__":
    set_registry(ROOT / "charts" / "cloudrc", sys.argv[1])
