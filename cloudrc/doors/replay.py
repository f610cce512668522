# SPDX-License-Identifier: Apache-2.0

"""Write the 3-D replay of a recorded flight as one page."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.files import write_atomically
from cloudrc.results.report.flown import flight_of
from cloudrc.results.report.folder import read_flown
from cloudrc.results.report.replay import write_page


def write_replay(run: Path, out: Path | None = None) -> Path:
    """Write the replay of a run, the folder or its MCAP file, and return the path of the page.

    By default the page is replay.html beside the recording, and replaces an earlier one.
    """
    recording, experiment = read_flown(run)
    page = write_page(flight_of(recording, experiment), experiment)
    path = out or (run if run.is_dir() else run.parent) / "replay.html"
    write_atomically(path, page.encode())
    return path
