"""`cloudrc link set` in a cluster: the ConfigMap's files become a profile, and that becomes files.

They go straight to both link containers, so that the change is in force within a second, and then
into the ConfigMap, so that it lasts. A trace lies beside the profile, and is named relative to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, NoReturn

from cloudrc.cli.link_cluster_hand import (
    Given,
    StrangeStateError,
    hand_to_both,
    needed,
    take_back,
)
from cloudrc.cluster.errors import ClusterError
from cloudrc.cluster.link import COMPONENTS, PROFILE, LinkParts, Place, write_files
from cloudrc.config import document
from cloudrc.config import document as yaml_text
from cloudrc.config.edit import DIRECTIONS, Edit, edit
from cloudrc.config.load import FILES
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.link.sidecar_handed import Handed
from cloudrc.link.state import CHANGE_FILE, LinkState, read_change

SIZE_MAX = 1_000_000
"""What a ConfigMap takes in all, a little less than its 1 MiB [bytes]."""
_KEY = re.compile(r"[^-._a-zA-Z0-9]")


class HandedOver(NamedTuple):
    """A change that the link containers have been given.

    Attributes:
        edit: What was changed.
        told: What uplink and downlink tell of themselves then.
        keep: Writes it into the ConfigMap, so that it lasts; raises a ClusterError.
        take_back: Hands the files of before over again, and says what holds then; "" if that is
            just what held before.
    """

    edit: Edit
    told: list[LinkState]
    keep: Callable[[], None]
    take_back: Callable[[], str]


def hand_profile(
    place: Place,
    link: LinkParts,
    profile: str | None,
    settings: Sequence[str],
    change: Callable[[Edit], str],
) -> HandedOver:
    """Change the profile of a release, and wait until both directions have decided.

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
    whole = needed(made.values, {**link.files, **files})
    before = read_change(link.files.get(CHANGE_FILE, "")).number
    handed = Handed(files[CHANGE_FILE], before, whole)
    answers = hand_to_both(place, link, dict.fromkeys(COMPONENTS, handed))
    given = Given(read_change(files[CHANGE_FILE]), answers)
    keep = partial(write_files, place, link.name, files)
    back = partial(take_back, place, link, given)
    if failed := [one for one in answers.values() if isinstance(one, CloudrcError)]:
        _keep_or_take_back(failed, given, keep, back)
    told = [one for one in answers.values() if isinstance(one, LinkState)]
    return HandedOver(made, told, partial(_keep_all, keep), back)


def _keep_all(keep: Callable[[], None]) -> None:
    """Make a change last that both directions have in force."""
    try:
        keep()
    except CloudrcError as error:
        raise ClusterError(f"{error}; the link changes, until its pods are replaced") from None


def _keep_or_take_back(
    failed: Sequence[CloudrcError],
    given: Given,
    keep: Callable[[], None],
    back: Callable[[], str],
) -> NoReturn:
    """Let the change reach by the ConfigMap whom it did not reach straight, or nobody.

    Raises:
        ClusterError: Always; it says what holds.
    """
    error: CloudrcError = failed[0]
    strange = any(isinstance(one, StrangeStateError) for one in failed)
    if not strange and not any(map(given.refused, COMPONENTS)):
        try:
            keep()
        except CloudrcError as refusal:
            if not any(map(given.took, COMPONENTS)):
                raise
            error = refusal
        else:
            raise ClusterError(
                f"{error}; the ConfigMap has the change, and the pods follow it within 2 minutes"
            )
    raise ClusterError("; ".join(filter(None, [str(error), back()])))


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
