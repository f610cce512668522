"""`cloudrc link set` in a cluster: the ConfigMap's files become a profile, and that becomes files.

A trace lies beside the profile in the ConfigMap, and is named relative to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from cloudrc.cli.link_edit import DIRECTIONS, FILES, Edit, edit
from cloudrc.cluster.link import PROFILE, read_profile_map, write_profile_map
from cloudrc.config import document, yaml_text
from cloudrc.errors import BadInputError
from cloudrc.link.state import CHANGE_FILE

if TYPE_CHECKING:
    from cloudrc.cluster.access import Release

SIZE_MAX = 1_000_000
"""What a ConfigMap takes in all, a little less than its 1 MiB [bytes]."""
_KEY = re.compile(r"[^-._a-zA-Z0-9]")


def change_profile(
    release: Release,
    profile: str | None,
    settings: Sequence[str],
    change: Callable[[Edit], str],
) -> Edit:
    """Change the profile of a release.

    Args:
        release: Whose link changes.
        profile: As `link_edit.edit` takes it.
        settings: Likewise.
        change: Says who changed it and why, as the text of the file beside the profile.

    Raises:
        CloudrcError: If what is asked for is not valid, or the cluster refuses.
    """
    found = read_profile_map(release)
    made, files = with_files(found.files, profile, settings)
    write_profile_map(release, found.name, {**files, CHANGE_FILE: change(made)})
    return made


def with_files(
    files: Mapping[str, str], profile: str | None, settings: Sequence[str]
) -> tuple[Edit, dict[str, str]]:
    """Edit the profile among these files.

    Returns:
        The edit, and the files that are new: the profile and the traces that it needs.

    Raises:
        BadInputError: If what is asked for is not valid, or too large for a ConfigMap.
    """
    with TemporaryDirectory(prefix="cloudrc-") as name:
        folder = Path(name).resolve()
        for key, text in files.items():
            (folder / key).write_text(text, encoding="utf-8")
        made = edit(document.read(folder / PROFILE, PROFILE), profile, settings)
        new: dict[str, str] = {}
        for way in DIRECTIONS:
            for key in FILES:
                path = made.values.get(way, {}).get(key)
                if path is not None:
                    made.values[way][key] = _bring(Path(path), folder, way, new)
    size = sum(len(text) for text in {**files, **new}.values())
    if size > SIZE_MAX:
        raise BadInputError(
            f"traces and profile have {size} bytes, a ConfigMap takes {SIZE_MAX}; give a trace "
            "with fewer rows, for example one per 20 ms"
        )
    return made, {PROFILE: yaml_text.write(made.values), **new}


def _bring(path: Path, folder: Path, way: str, new: dict[str, str]) -> str:
    """Name a trace as it lies beside the profile, where it is put if it comes from here."""
    if path.parent == folder:
        return path.name
    key = f"{way}-{_KEY.sub('_', path.name)}"
    new[key] = path.read_text(encoding="utf-8-sig")
    return key
