"""Change the link of a release in flight: `cloudrc link set` in a cluster.

The new profile goes into both running link containers, so that it is in force within a second, and
then into the ConfigMap, so that it survives a restart. If only one direction accepts a change, both
get the old files again: the one that accepted it, and the other one, which would otherwise read the
refused files when it restarts. Traces are files beside the profile.

For speed, this module uses kubectl, which starts in 0.1 s, not the Python client, which takes
0.5 s; and a few lines of `sh` in the containers, not Python.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, NoReturn, TypeAlias

from cloudrc.cluster.tools import ClusterError, run
from cloudrc.config.document import parse_yaml, read_document, write_yaml
from cloudrc.config.load import FILE_READERS
from cloudrc.config.profile_edit import DIRECTIONS, TIME_LINE_KEYS, Edit, edit_profile
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.link.follow import HANDED_FILE, Handed, write_handed
from cloudrc.link.state import CHANGE_FILE, STATE_FILE, Change, LinkState, from_text, read_change

PROFILE = "profile.yaml"
"""Key of the profile in the ConfigMap."""
COMPONENTS = ("world", "cloud")
"""Components whose link containers shape the uplink and the downlink, in this order."""
READ_LIMIT = 15.0
"""Time limit for the API server to answer [s]."""
FOLDER = "/run/cloudrc"
"""Folder in a link container with its route, its state and the change that it gets."""
APPLY_LIMIT = 5.0
"""Time limit for the sidecar to apply a change [s]; it takes 0.2 s."""
SEND_LIMIT = 25.0
"""Time limit to send a change to a container and to read the answer [s]."""
SIZE_MAX = 1_000_000
"""Largest size of a ConfigMap's files, a little less than its limit of 1 MiB [bytes]."""
_COMPONENT = "app.kubernetes.io/component"
_LOOK_PERIOD = 0.02
"""Time between two looks at the sidecar's state [s]."""
_KEY = re.compile(r"[^-._a-zA-Z0-9]")
"""Pattern of a character that no key of a ConfigMap may have."""


@dataclass(frozen=True)
class ReleasePlace:
    """Context, namespace and name of a release; None is kubectl's default.

    Attributes:
        context: Context of the kubeconfig.
        namespace: Namespace of the release.
        name: Name of the Helm release.
    """

    context: str | None
    namespace: str | None
    name: str

    @property
    def flags(self) -> list[str]:
        """Flags of kubectl that select context and namespace."""
        context = [f"--context={self.context}"] if self.context else []
        return context + ([f"--namespace={self.namespace}"] if self.namespace else [])


@dataclass(frozen=True)
class LinkParts:
    """ConfigMap and pods of a release's link.

    Attributes:
        name: Name of the ConfigMap that the link containers follow.
        files: Its files: the profile, its traces, the record of the last change.
        pods: Component -> name of its newest running pod.
    """

    name: str
    files: dict[str, str]
    pods: dict[str, str]


def read_link(place: ReleasePlace) -> LinkParts | None:
    """Read a release's link with one kubectl command; None if a part of it is missing.

    Raises:
        ClusterError: If kubectl fails; with its message.
    """
    selector = f"app.kubernetes.io/name=cloudrc,app.kubernetes.io/instance={place.name}"
    words = [*place.flags, "get", "configmaps,pods", f"--selector={selector}", "--output=json"]
    found = json.loads(run("kubectl", words, timeout=READ_LIMIT))["items"]
    maps = [
        item for item in found if item["kind"] == "ConfigMap" and PROFILE in item.get("data", {})
    ]
    pods = {component: _newest(found, component) for component in COMPONENTS}
    if not maps or None in pods.values():
        return None
    names = {component: str(name) for component, name in pods.items()}
    return LinkParts(str(maps[0]["metadata"]["name"]), dict(maps[0]["data"]), names)


def write_files(place: ReleasePlace, name: str, files: Mapping[str, str]) -> None:
    """Write files into the ConfigMap; its other files stay.

    Raises:
        ClusterError: If the cluster refuses.
    """
    words = ["patch", "configmap", name, "--type=merge", "--patch-file=/dev/stdin"]
    run("kubectl", [*place.flags, *words], timeout=READ_LIMIT, given=json.dumps({"data": files}))


def _newest(found: list[dict[str, Any]], component: str) -> str | None:
    """Return the name of the newest running pod of a component."""
    pods = [
        item["metadata"]
        for item in found
        if item["kind"] == "Pod"
        and item["metadata"]["labels"].get(_COMPONENT) == component
        and item["status"].get("phase") == "Running"
        and "deletionTimestamp" not in item["metadata"]
    ]
    newest = max(pods, key=lambda metadata: str(metadata["creationTimestamp"]), default=None)
    return str(newest["name"]) if newest else None


APPLY_SCRIPT = f"""\
cd "$1" 2>/dev/null && test -f {STATE_FILE} || {{
    echo 'error: no link runs here;' >&2; exit 2; }}
draft=.{HANDED_FILE}.$$
cat > $draft && test "$(wc -c < $draft)" -eq "$3" && mv $draft {HANDED_FILE} || {{
    rm -f $draft; echo 'error: the change arrived incomplete;' >&2; exit 2; }}
for _ in $(seq {round(APPLY_LIMIT / _LOOK_PERIOD)}); do
    grep -qF "\\"$2\\"" {STATE_FILE} && break
    sleep {_LOOK_PERIOD}
done
cat {STATE_FILE}
"""
"""Script for `sh` in a link container. Its arguments are folder, number of the change and length of
the document on its standard input. It puts the document where the sidecar reads it, in one step,
waits until the sidecar has accepted or refused it, and prints the sidecar's state."""


def send_change(place: ReleasePlace, pod: str, handed: Handed) -> str:
    """Send a change to a pod's link container, and wait until it has accepted or refused it.

    Args:
        place: The release.
        pod: Name of the pod.
        handed: The change.

    Returns:
        The state of the link after that, as JSON.

    Raises:
        ClusterError: If kubectl or the container refuses.
    """
    document, number = write_handed(handed), read_change(handed.change).number
    words = ["sh", "-c", APPLY_SCRIPT, "sh", FOLDER, number, str(len(document.encode()))]
    command = [*place.flags, "exec", "--stdin", pod, "--container=link", "--", *words]
    return run("kubectl", command, timeout=SEND_LIMIT, given=document)


DIRECTION_OF = dict(zip(COMPONENTS, DIRECTIONS, strict=True))
"""Component -> direction that its link container shapes."""
Answer: TypeAlias = LinkState | CloudrcError
"""State that a link container reports, or the error if it reports none."""


@dataclass(frozen=True)
class SentChange:
    """A change that was sent to both link containers.

    Attributes:
        change: Number, cause, and whether time lines start again.
        answers: Component -> answer of its container.
    """

    change: Change
    answers: Mapping[str, Answer]

    def took(self, part: str) -> bool:
        """Whether the change is in force in a component's container."""
        answer = self.answers[part]
        return isinstance(answer, LinkState) and answer.change == self.change.number

    def refused(self, part: str) -> bool:
        """Whether a component's container has refused the change."""
        answer = self.answers[part]
        return isinstance(answer, LinkState) and answer.refused == self.change.number


class UnknownStateError(ClusterError):
    """A link container reports a state in the format of another version."""


def send_to_both(
    place: ReleasePlace, link: LinkParts, given: Mapping[str, Handed]
) -> dict[str, Answer]:
    """Send a change to each link container, and wait until both have accepted or refused it.

    Args:
        place: The release.
        link: Its link.
        given: Component -> change for its container.

    Returns:
        Component -> answer of its container.
    """

    def hand(part: str) -> Answer:
        try:
            return from_text(send_change(place, link.pods[part], given[part]))
        except CloudrcError as error:
            return error
        except ValueError as error:
            return UnknownStateError(f"a link container has another version: {error}")

    with ThreadPoolExecutor(len(COMPONENTS)) as pool:
        return dict(zip(COMPONENTS, pool.map(hand, COMPONENTS), strict=True))


def needed_files(values: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, str]:
    """Select the profile and the files that it names from a ConfigMap's files.

    Args:
        values: Values of the profile.
        files: All files.
    """
    ways = [value for value in values.values() if isinstance(value, dict)]
    named = {Path(str(way[key])).name for way in ways for key in FILE_READERS if way.get(key)}
    return {name: text for name, text in files.items() if name == PROFILE or name in named}


def roll_back(place: ReleasePlace, link: LinkParts, given: SentChange) -> str:
    """Send the old files to both link containers again.

    Args:
        place: The release.
        link: Its link before the change.
        given: The change, which not both containers accepted.

    Returns:
        The differences from the state before the change, and what to do; "" if there are none.
    """
    values, _ = parse_yaml(link.files[PROFILE], PROFILE)
    values = values if isinstance(values, dict) else {}
    files = needed_files(values, link.files)
    before = read_change(link.files.get(CHANGE_FILE, "")).number
    number, cause = f"{given.change.number}-back", f"taken back: {given.change.cause}"
    documents = {}
    for part in COMPONENTS:
        # A direction that never applied the change continues its old time line.
        restart = given.change.restart and given.took(part)
        change = {"number": number, "cause": cause, "restart": restart}
        documents[part] = Handed(json.dumps(change) + "\n", before, files)
    again = SentChange(Change(number, cause), send_to_both(place, link, documents))
    return "; ".join(_words(place, link, values, given, again))


def _words(
    place: ReleasePlace,
    link: LinkParts,
    values: Mapping[str, Any],
    given: SentChange,
    again: SentChange,
) -> Iterator[str]:
    """Describe the final state of each direction."""
    for part, way in DIRECTION_OF.items():
        own, answer = values.get(way) or {}, again.answers[part]
        if again.took(part):
            if given.took(part):
                restarted = given.change.restart and any(own.get(key) for key in TIME_LINE_KEYS)
                timed = "; its time line starts again" if restarted else ""
                yield f"the {way} had the change for a moment and has its old profile again{timed}"
        elif isinstance(answer, LinkState) and not again.refused(part):
            yield f"the {way} (pod {link.pods[part]}) gets its old profile when it responds"
        else:
            keeps = "keeps the change" if given.took(part) else "may have the change"
            if given.refused(part):
                keeps = "may apply the refused change when its container restarts"
            why = answer.refusal if isinstance(answer, LinkState) else str(answer)
            yield (
                f"the {way} (pod {link.pods[part]}) {keeps}, because the old profile could not be "
                f"restored: {why}; send the old profile to both again: {_command(place, way, own)}"
            )


def _command(place: ReleasePlace, way: str, own: Mapping[str, Any]) -> str:
    """Return a command that sets a value to its present value, and so sends the whole profile.

    The value is `keep_order`, which no time line changes.
    """
    order = "true" if own.get("keep_order") else "false"
    words = ["cloudrc link set", f"{way}.keep_order={order}", f"--release={place.name}"]
    return " ".join([*words, *place.flags])


class AppliedEdit(NamedTuple):
    """A change that was sent to both link containers.

    Attributes:
        edit: The edited profile.
        told: States of uplink and downlink after the change.
        keep: Writes the change into the ConfigMap, so that it survives a restart; raises a
            ClusterError.
        take_back: Sends the old files again, and returns the differences from the state before;
            "" if there are none.
    """

    edit: Edit
    told: list[LinkState]
    keep: Callable[[], None]
    take_back: Callable[[], str]


def change_profile(
    place: ReleasePlace,
    link: LinkParts,
    profile: str | None,
    settings: Sequence[str],
    change: Callable[[Edit], str],
) -> AppliedEdit:
    """Change the profile of a release, and wait until both directions have accepted or refused it.

    Args:
        place: The release.
        link: Its present link.
        profile: New profile, as in `cloudrc.config.edit.edit`.
        settings: Values to set, as in `cloudrc.config.edit.edit`.
        change: Returns the text of the file beside the profile: who changed it, and why.

    Raises:
        CloudrcError: If the request is not valid, or the cluster refuses.
    """
    edited, files = with_files(link.files, profile, settings)
    files[CHANGE_FILE] = change(edited)
    whole = needed_files(edited.values, {**link.files, **files})
    before = read_change(link.files.get(CHANGE_FILE, "")).number
    handed = Handed(files[CHANGE_FILE], before, whole)
    answers = send_to_both(place, link, dict.fromkeys(COMPONENTS, handed))
    given = SentChange(read_change(files[CHANGE_FILE]), answers)
    keep = partial(write_files, place, link.name, files)
    back = partial(roll_back, place, link, given)
    if failed := [answer for answer in answers.values() if isinstance(answer, CloudrcError)]:
        _keep_or_take_back(failed, given, keep, back)
    told = [answer for answer in answers.values() if isinstance(answer, LinkState)]
    return AppliedEdit(edited, told, partial(_keep_applied, keep), back)


def _keep_applied(keep: Callable[[], None]) -> None:
    """Write a change that is in force in both directions into the ConfigMap."""
    try:
        keep()
    except CloudrcError as error:
        raise ClusterError(f"{error}; the change is in force until the pods are replaced") from None


def _keep_or_take_back(
    failed: Sequence[CloudrcError],
    given: SentChange,
    keep: Callable[[], None],
    back: Callable[[], str],
) -> NoReturn:
    """Write the change into the ConfigMap if no container refused it; else take it back.

    Raises:
        ClusterError: Always; it describes the final state.
    """
    error: CloudrcError = failed[0]
    other_version = any(isinstance(each, UnknownStateError) for each in failed)
    if not other_version and not any(map(given.refused, COMPONENTS)):
        try:
            keep()
        except CloudrcError as refusal:
            if not any(map(given.took, COMPONENTS)):
                raise
            error = refusal
        else:
            raise ClusterError(
                f"{error}; the ConfigMap has the change, and the pods apply it within 2 minutes"
            )
    raise ClusterError("; ".join(filter(None, [str(error), back()])))


def with_files(
    files: Mapping[str, str], profile: str | None, settings: Sequence[str]
) -> tuple[Edit, dict[str, str]]:
    """Edit the profile among these files.

    Returns:
        The edited profile, and the new files: the profile and its new traces.

    Raises:
        BadInputError: If the request is not valid, or the files are too large for a ConfigMap.
    """
    with TemporaryDirectory(prefix="cloudrc-") as name:
        folder = Path(name).resolve()
        for key, text in files.items():
            (folder / key).write_text(text, encoding="utf-8")
        edited = edit_profile(read_document(folder / PROFILE, PROFILE), profile, settings)
        new: dict[str, str] = {}
        for way in DIRECTIONS:
            for key in FILE_READERS:
                path = edited.values.get(way, {}).get(key)
                if path is not None:
                    edited.values[way][key] = _add_file(Path(path), folder, way, new)
    size = sum(len(text) for text in {**files, **new}.values())
    if size > SIZE_MAX:
        raise BadInputError(
            f"traces and profile have {size} bytes, a ConfigMap takes {SIZE_MAX}; use a trace "
            "with fewer rows, for example one per 20 ms"
        )
    return edited, {PROFILE: write_yaml(edited.values), **new}


def _add_file(path: Path, folder: Path, way: str, new: dict[str, str]) -> str:
    """Return a trace's name beside the profile; add its text to `new` if it is not there yet."""
    if path.parent == folder:
        return path.name
    key = f"{way}-{_KEY.sub('_', path.name)}"
    new[key] = path.read_text(encoding="utf-8-sig")
    return key
