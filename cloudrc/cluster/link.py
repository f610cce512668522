"""The link of a release while it flies: its profile's ConfigMap, and what its containers tell.

kubectl does all of it: it starts in a tenth of a second, the Python client in half of one, and a
change of the link is to be in force within a second.

A change of the link goes into a pod's link container; what that tells of itself comes out.

What is done inside is a few lines of `sh`, which every image has: two Pythons that start in pods
at once take as long as all else of `cloudrc link set`, 0.5 s where a processor is slow.

Both link containers of a release at once: a profile goes in, what each says of it comes out.

A link is set whole or not at all. Where only one direction takes a change, the files of before are
handed to both: to the one that took it, and to the other one, which would else find in a restart
what it has refused.

`cloudrc link set` in a cluster: the ConfigMap's files become a profile, and that becomes files.

They go straight to both link containers, so that the change is in force within a second, and then
into the ConfigMap, so that it lasts. A trace lies beside the profile, and is named relative to it.
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
from cloudrc.config import document
from cloudrc.config import document as yaml_text
from cloudrc.config.edit import DIRECTIONS, TIME_LINES, Edit, edit
from cloudrc.config.load import FILES
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.link.follow import HANDED_FILE, Handed, write_handed
from cloudrc.link.state import CHANGE_FILE, STATE_FILE, Change, LinkState, from_text, read_change

PROFILE = "profile.yaml"
"""Key of the ConfigMap."""
COMPONENTS = ("world", "cloud")
"""Whose link containers shape uplink and downlink."""
READ_LIMIT = 15.0
"""For the API server to answer [s]."""
_COMPONENT = "app.kubernetes.io/component"


@dataclass(frozen=True)
class Place:
    """Where a release is, as kubectl is told; None is its own default.

    Attributes:
        context: Of the kubeconfig.
        namespace: Where the release is.
        name: Of the release, as Helm knows it.
    """

    context: str | None
    namespace: str | None
    name: str

    @property
    def flags(self) -> list[str]:
        """What kubectl has to be told."""
        context = [f"--context={self.context}"] if self.context else []
        return context + ([f"--namespace={self.namespace}"] if self.namespace else [])


@dataclass(frozen=True)
class LinkParts:
    """What there is of a release's link.

    Attributes:
        name: Of the ConfigMap that the link containers follow.
        files: Its files: the profile, its traces, who changed it.
        pods: The newest running pod of each component.
    """

    name: str
    files: dict[str, str]
    pods: dict[str, str]


def read_link(place: Place) -> LinkParts | None:
    """Look at a release with one request of kubectl; None if its link is not there, or in part.

    Raises:
        ClusterError: If kubectl fails; with what it said.
    """
    selector = f"app.kubernetes.io/name=cloudrc,app.kubernetes.io/instance={place.name}"
    words = [*place.flags, "get", "configmaps,pods", f"--selector={selector}", "--output=json"]
    found = json.loads(run("kubectl", words, timeout=READ_LIMIT))["items"]
    maps = [one for one in found if one["kind"] == "ConfigMap" and PROFILE in one.get("data", {})]
    pods = {part: _newest(found, part) for part in COMPONENTS}
    if not maps or None in pods.values():
        return None
    named = {part: str(name) for part, name in pods.items()}
    return LinkParts(str(maps[0]["metadata"]["name"]), dict(maps[0]["data"]), named)


def write_files(place: Place, name: str, files: Mapping[str, str]) -> None:
    """Put files into the ConfigMap; those not named stay.

    Raises:
        ClusterError: If it is refused.
    """
    words = ["patch", "configmap", name, "--type=merge", "--patch-file=/dev/stdin"]
    run("kubectl", [*place.flags, *words], timeout=READ_LIMIT, given=json.dumps({"data": files}))


def _newest(found: list[dict[str, Any]], component: str) -> str | None:
    """Name the newest running pod of a component."""
    pods = [
        one["metadata"]
        for one in found
        if one["kind"] == "Pod"
        and one["metadata"]["labels"].get(_COMPONENT) == component
        and one["status"].get("phase") == "Running"
        and "deletionTimestamp" not in one["metadata"]
    ]
    newest = max(pods, key=lambda one: str(one["creationTimestamp"]), default=None)
    return str(newest["name"]) if newest else None


FOLDER = "/run/cloudrc"
"""In a link container: where the chart lets route, state and what is handed over lie."""
PATIENCE = 5.0
"""For the sidecar to take a change over [s]; it takes 0.2."""
HAND_LIMIT = 25.0
"""For a container to take a change over and tell of it [s]."""
_LOOK_PERIOD = 0.02
INSIDE = f"""\
cd "$1" 2>/dev/null && test -f {STATE_FILE} || {{
    echo 'error: no link is shaped here;' >&2; exit 2; }}
draft=.{HANDED_FILE}.$$
cat > $draft && test "$(wc -c < $draft)" -eq "$3" && mv $draft {HANDED_FILE} || {{
    rm -f $draft; echo 'error: the change did not arrive whole;' >&2; exit 2; }}
for _ in $(seq {round(PATIENCE / _LOOK_PERIOD)}); do
    grep -qF "\\"$2\\"" {STATE_FILE} && break
    sleep {_LOOK_PERIOD}
done
cat {STATE_FILE}
"""
"""For `sh`, with folder, number of the change and length of the document, which it reads: leaves it
where the sidecar looks, in one step, and tells what holds once the sidecar has decided."""


def hand_over(place: Place, pod: str, handed: Handed) -> str:
    """Hand a change to a pod's link container, and wait until it has decided.

    Args:
        place: Of the release.
        pod: Its name.
        handed: The change.

    Returns:
        What the link tells of itself then, as JSON.

    Raises:
        ClusterError: If kubectl or the container refuses.
    """
    document, number = write_handed(handed), read_change(handed.change).number
    words = ["sh", "-c", INSIDE, "sh", FOLDER, number, str(len(document.encode()))]
    command = [*place.flags, "exec", "--stdin", pod, "--container=link", "--", *words]
    return run("kubectl", command, timeout=HAND_LIMIT, given=document)


WAYS = dict(zip(COMPONENTS, DIRECTIONS, strict=True))
"""What the link container of a component shapes."""
Answer: TypeAlias = LinkState | CloudrcError
"""What a link container tells of itself, or why it tells nothing."""


@dataclass(frozen=True)
class Given:
    """A change that both containers were asked to take over.

    Attributes:
        change: Number, cause, and whether time lines begin anew.
        answers: What each of the components' containers said.
    """

    change: Change
    answers: Mapping[str, Answer]

    def took(self, part: str) -> bool:
        """Whether a component's container has it in force."""
        told = self.answers[part]
        return isinstance(told, LinkState) and told.change == self.change.number

    def refused(self, part: str) -> bool:
        """Whether a component's container has said that it cannot."""
        told = self.answers[part]
        return isinstance(told, LinkState) and told.refused == self.change.number


class StrangeStateError(ClusterError):
    """A link container that tells of itself in another way than this version's."""


def hand_to_both(place: Place, link: LinkParts, given: Mapping[str, Handed]) -> dict[str, Answer]:
    """Hand a document to each link container, and wait until both have decided.

    Args:
        place: Of the release.
        link: Its link.
        given: By component.

    Returns:
        By component.
    """

    def hand(part: str) -> Answer:
        try:
            return from_text(hand_over(place, link.pods[part], given[part]))
        except CloudrcError as error:
            return error
        except ValueError as error:
            return StrangeStateError(f"a link container is of another version: {error}")

    with ThreadPoolExecutor(len(COMPONENTS)) as pool:
        return dict(zip(COMPONENTS, pool.map(hand, COMPONENTS), strict=True))


def needed(values: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, str]:
    """Choose from a ConfigMap's files the profile and what it names.

    Args:
        values: The profile, read.
        files: All there are.
    """
    ways = [one for one in values.values() if isinstance(one, dict)]
    named = {Path(str(one[key])).name for one in ways for key in FILES if one.get(key)}
    return {name: text for name, text in files.items() if name == PROFILE or name in named}


def take_back(place: Place, link: LinkParts, given: Given) -> str:
    """Hand the files of before to both link containers again.

    Args:
        place: Of the release.
        link: Its link as it was before.
        given: What was not taken over by both.

    Returns:
        What holds now where that is not just as before, and what to do; "" if there is nothing.
    """
    values, _ = document.parse(link.files[PROFILE], PROFILE)
    values = values if isinstance(values, dict) else {}
    files = needed(values, link.files)
    before = read_change(link.files.get(CHANGE_FILE, "")).number
    number, cause = f"{given.change.number}-back", f"taken back: {given.change.cause}"
    documents = {}
    for part in COMPONENTS:
        # Where it never took force, the old time line goes on.
        restart = given.change.restart and given.took(part)
        change = {"number": number, "cause": cause, "restart": restart}
        documents[part] = Handed(json.dumps(change) + "\n", before, files)
    again = Given(Change(number, cause), hand_to_both(place, link, documents))
    return "; ".join(_words(place, link, values, given, again))


def _words(
    place: Place, link: LinkParts, values: Mapping[str, Any], given: Given, again: Given
) -> Iterator[str]:
    """Say for each direction what it has in the end."""
    for part, way in WAYS.items():
        own, told = values.get(way) or {}, again.answers[part]
        if again.took(part):
            if given.took(part):
                anew = given.change.restart and any(own.get(key) for key in TIME_LINES)
                timed = ", its time line begins anew" if anew else ""
                yield f"the {way} had taken the change, and has its old profile back{timed}"
        elif isinstance(told, LinkState) and not again.refused(part):
            yield f"the {way} (pod {link.pods[part]}) finds its old profile once it moves again"
        else:
            keeps = "keeps the change" if given.took(part) else "may have the change"
            if given.refused(part):
                keeps = "may take what it refused when its container starts again"
            why = told.refusal if isinstance(told, LinkState) else str(told)
            yield (
                f"the {way} (pod {link.pods[part]}) {keeps}, as it could not be taken back: {why}; "
                f"hand both the old profile again: {_command(place, way, own)}"
            )


def _command(place: Place, way: str, own: Mapping[str, Any]) -> str:
    """Give the command that sets a value as it is, and so hands over the profile that lasts.

    The order is on no time line, and setting it leaves all else as it is.
    """
    order = "true" if own.get("keep_order") else "false"
    words = ["cloudrc link set", f"{way}.keep_order={order}", f"--release={place.name}"]
    return " ".join([*words, *place.flags])


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
