# SPDX-License-Identifier: Apache-2.0

"""Write the page "fly it here" with its flights, style and script inside."""

from __future__ import annotations

import gzip
import json
from base64 import b64encode
from pathlib import Path
from string import Template
from typing import Any

HERE = Path(__file__).parent
BYTES_MAX = 3_500_000
"""Largest size of the page: people wait for it."""


def write(target: Path, shown: dict[str, Any]) -> None:
    """Write the page that shows a document of `flights.document`."""
    packed = gzip.compress(json.dumps(shown, separators=(",", ":")).encode(), mtime=0)
    text = Template((HERE / "page.html").read_text("utf-8")).substitute(
        style=(HERE / "page.css").read_text("utf-8"),
        script=(HERE / "page.js").read_text("utf-8"),
        data=b64encode(packed).decode(),
    )
    if (size := len(text.encode())) > BYTES_MAX:
        raise SystemExit(f"{target}: has {size} bytes, above {BYTES_MAX}: fly fewer recipes")
    target.write_text(text, encoding="utf-8")
