# SPDX-License-Identifier: Apache-2.0

"""Pack the Helm chart with the same bytes for the same files: used by `make dist`.

`helm package` stamps each file with the present time, before Helm 4 always. This tool takes its
archive and sets owner, rights and times to fixed values.

    python -m tools.pack_chart FOLDER EPOCH            the chart of the working tree
    python -m tools.pack_chart FILE.tgz --of COMMIT    that of a commit, for the tests of upgrades
"""

from __future__ import annotations

import gzip
import io
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def pack(chart: Path, folder: Path, epoch: int) -> Path:
    """Pack `chart` into `folder`; `epoch` is the time of all files, in Unix time [s]."""
    with tempfile.TemporaryDirectory() as scratch:
        command = ["helm", "package", str(chart), "--destination", scratch]
        subprocess.run(command, check=True, capture_output=True)
        (made,) = Path(scratch).glob("*.tgz")
        target = folder / made.name
        folder.mkdir(parents=True, exist_ok=True)
        target.write_bytes(_same_bytes(made, epoch))
    return target


def pack_commit(commit: str, file: Path) -> None:
    """Pack the chart of a commit into `file`; its time is the time of all files."""
    show = ["git", "-C", str(ROOT), "show", "--no-patch", "--format=%ct", commit]
    epoch = int(subprocess.run(show, check=True, capture_output=True).stdout)
    archive = ["git", "-C", str(ROOT), "archive", commit, "charts/cloudrc"]
    files = subprocess.run(archive, check=True, capture_output=True).stdout
    with tempfile.TemporaryDirectory() as scratch:
        subprocess.run(["tar", "-x", "-C", scratch], input=files, check=True)
        made = pack(Path(scratch, "charts", "cloudrc"), Path(scratch, "packed"), epoch)
        file.write_bytes(made.read_bytes())


def _same_bytes(archive: Path, epoch: int) -> bytes:
    """Return the archive's content, sorted by name, with fixed owner, rights and times."""
    packed = io.BytesIO()
    with (
        tarfile.open(archive) as source,
        gzip.GzipFile(filename="", fileobj=packed, mode="wb", mtime=epoch) as compressed,
        tarfile.open(fileobj=compressed, mode="w", format=tarfile.USTAR_FORMAT) as target,
    ):
        for member in sorted(source.getmembers(), key=lambda member: member.name):
            entry = tarfile.TarInfo(member.name)
            entry.size = member.size
            entry.mtime = epoch
            entry.mode = 0o644
            target.addfile(entry, source.extractfile(member))
    return packed.getvalue()


if __name__ == "__main__":
    if sys.argv[2:3] == ["--of"]:
        pack_commit(sys.argv[3], Path(sys.argv[1]))
    else:
        print(pack(ROOT / "charts" / "cloudrc", Path(sys.argv[1]), int(sys.argv[2])))
