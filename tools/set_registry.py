# SPDX-License-Identifier: Apache-2.0

"""Write the registry of a release's images into the chart, before wheel and chart are built.

    python tools/set_registry.py REGISTRY                         before wheels are built
    python tools/set_registry.py REGISTRY world=sha256:... ...    the chart names what is published

The workflow `release` runs this. In a clone the registry stays empty, because the images that `make
images` builds are in none.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]


def set_registry(chart: Path, registry: str, digests: Mapping[str, str] | None = None) -> None:
    """Set `registry`, such as ghcr.io/me, in values, README and examples of the folder `chart`.

    `digests` are those of the images: role, such as "world" -> sha256:...
    """
    _replace(chart / "values.yaml", '\n  registry: ""\n', f"\n  registry: {registry}\n")
    row = '| `image.registry` | `"{}"` |'
    _replace(chart / "README.md", row.format(""), row.format(registry))
    for job in sorted((chart / "examples").glob("*.yaml")):
        if " image: cloudrc/" in job.read_text("utf-8"):
            _replace(job, " image: cloudrc/", f" image: {registry}/cloudrc/")
    for role, digest in (digests or {}).items():
        _set_digest(chart, role, digest)


def _set_digest(chart: Path, role: str, digest: str) -> None:
    values = (chart / "values.yaml").read_text("utf-8")
    start = values.index(f" repository: cloudrc/{role}\n")
    end = values.index('digest: ""', start)
    about = values[start:end]
    _replace(chart / "values.yaml", f'{about}digest: ""', f"{about}digest: {digest}")
    for job in sorted((chart / "examples").glob("*.yaml")):
        text = job.read_text("utf-8")
        job.write_text(re.sub(rf"(/cloudrc/{role}):\S+", rf"\1@{digest}", text), "utf-8")


def _replace(path: Path, old: str, new: str) -> None:
    """Replace the only `old` in a file, which must be there."""
    text = path.read_text("utf-8")
    if text.count(old) != 1:
        sys.exit(f"{path}: has {text.count(old)} times {old!r}, not once")
    path.write_text(text.replace(old, new), "utf-8")


if __name__ == "__main__":
    given = (word.split("=", 1) for word in sys.argv[2:])
    set_registry(ROOT / "charts" / "cloudrc", sys.argv[1], dict(given))
