"""`cloudrc link set` in a cluster: the ConfigMap's files become a profile, and that becomes files.

They go straight to both link containers, so that the change is in force within a second, and then
into the ConfigMap, so that it lasts. A trace lies beside the profile, and is named relative to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from cloudrc.cli.link_edit import DIRECTIONS, Edit, edit
from cloudrc.cluster.errors import ClusterError
from cloudrc.cluster.link import (
    COMPONENTS,
    PROFILE,
    LinkParts,
    Place,
    hand_over,
    write_files,
)
from cloudrc.config import document, yaml_text
from cloudrc.config.load import FILES
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.link.sidecar_handed import Handed, write_handed
from cloudrc.link.state import CHANGE_FILE, read_change

SIZE_MAX = 1_000_000
"""What a ConfigMap takes in all, a little less than its 1 MiB [bytes]."""
_KEY = re.compile(r"[^-._a-zA-Z0-9]")


class HandedOver(NamedTuple):
    """A change that the link containers have been given.

    Attributes:
        edit: What was changed.
        told: What uplink and downlink tell of themselves then.
        keep: Writes it into the ConfigMap, so that it lasts; raises a ClusterError.
    """

    edit: Edit
    told: list[str]
    keep: Callable[[], None]


def hand_profile(
    place: Place,
    link: LinkParts,
    profile: str | None,
    settings: Sequence[str],
    change: Callable[[Edit], str],
) -> HandedOver:
    """Change the profile of a release, and wait until both directions have taken it over.

    Args:
        place: Where the release is.
        link: Its link as it is.
        profile: As `link_edit.edit` takes it.
        settings: Likewise.
        change: Says who changed it and why, as the text of the file beside the profile.

    Raises:
        CloudrcError: If what is asked for is not valid, or the cluster refuses.
    """
    made, files = with_files(link.files, profile, settings)
    files[CHANGE_FILE] = change(made)
    named = {str(one[key]) for one in made.values.values() if isinstance(one, dict)
             for key in FILES if key in one}  # fmt: skip
    whole = {key: text for key, text in {**link.files, **files}.items() if key in named}
    before = read_change(link.files.get(CHANGE_FILE, "")).number
    handed = Handed(files[CHANGE_FILE], before, {PROFILE: files[PROFILE], **whole})
    text = write_handed(handed)
    with ThreadPoolExecutor(len(COMPONENTS)) as pool:
        told = [pool.submit(hand_over, place, link.pods[part], text) for part in COMPONENTS]
    refused = [error for one in told if isinstance(error := one.exception(), CloudrcError)]

    def keep() -> None:
        try:
            write_files(place, link.name, files)
        except CloudrcError as error:
            if len(refused) == len(told):
                raise
            text = f"{error}; the link changes, until its containers start again"
            raise ClusterError(text) from None

    if refused:
        keep()
        raise ClusterError(
            f"{refused[0]}; the ConfigMap has the change, and the pods follow it within 2 minutes"
        )
    return HandedOver(made, [one.result() for one in told], keep)


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
