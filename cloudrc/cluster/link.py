# SPDX-License-Identifier: Apache-2.0

"""Change the link of a release in flight, for `cloudrc link set` in a cluster.

First, `send` sends the new profile to the link containers of both pods, by the same request as in a
local run (`link.control`); they apply it within a second. Then `keep` writes it into the ConfigMap,
which restarted containers read. If a container does not take the profile, the ConfigMap stays
unchanged. If a step fails, the error message lists the places where the change is in force. The
files of traces are sent and stored with the profile.

This module uses kubectl, which starts in 0.1 s; the Python client takes 0.5 s.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from cloudrc.base.errors import CloudrcError, RejectedError, TimedOutError
from cloudrc.base.outside.document import Document, write_yaml
from cloudrc.cluster.client import COMPONENTS, ClusterError, Release, run
from cloudrc.cluster.pods import INDEX
from cloudrc.cluster.releases import CLOUDRC, COMPONENT, INSTANCE, no_release, several_releases
from cloudrc.config.link_edit import Edit, edit_profile
from cloudrc.config.load import load_link
from cloudrc.config.problems import problem_at
from cloudrc.config.profile import DIRECTIONS, FILE_READERS
from cloudrc.link.control import APPLY_LIMIT, SOCKET, put_request, read_answer
from cloudrc.link.follow import PROFILE
from cloudrc.link.state import CHANGE_FILE, ChangeFacts, LinkState, write_change

FOLDER = "/run/cloudrc"
"""Folder in a link container with the files of the link: route, state, socket."""
EXPERIMENT = "experiment.yaml"
"""Key of the experiment in its ConfigMap."""
SIZE_MAX = 1_000_000
"""Largest total size of the files in a ConfigMap [bytes], a little below Kubernetes' 1 MiB."""


@dataclass(frozen=True)
class LinkParts:
    """The parts of a release's emulated link: its ConfigMap and the pods with link containers."""

    release: str  # name of the release
    name: str  # of the ConfigMap that the link containers follow
    files: dict[str, str]  # of the ConfigMap: profile, traces, record of the last change; and the
    # experiment, from which the link comes if no profile is given
    pods: dict[str, str]  # component -> name of its newest running pod


def read_link(release: Release) -> LinkParts:
    """Read a release's link with one kubectl command.

    If the name of `release` is "", read the link of the only release in the namespace. Raise a
    StateError if there are several, a ClusterError if the release has no link, or if a pod does not
    run.
    """
    selector = f"{CLOUDRC},{INSTANCE}={release.name}" if release.name else CLOUDRC
    words = [*release.flags, "get", "configmaps,pods", f"--selector={selector}", "--output=json"]
    found = json.loads(run("kubectl", words))["items"]
    maps = [each for each in found if PROFILE in each.get("data", {})]
    names = {each["metadata"]["labels"].get(INSTANCE, release.name) for each in maps}
    if len(names) > 1:
        raise several_releases(release, list(names))
    release = replace(release, name=next(iter(names), release.name))
    if not maps:
        raise no_release(release)
    pods = _running_pods(found)
    if not pods.keys() >= set(COMPONENTS):
        raise ClusterError(f"a pod of {release} does not run")
    if any(each["kind"] == "Pod" and INDEX in each["metadata"]["labels"] for each in found):
        change = release.helm_upgrade("link.profile=NAME")
        raise ClusterError(f"{release} is a fleet; change its link: {change}")
    experiments = [each["data"] for each in found if EXPERIMENT in each.get("data", {})]
    files = {EXPERIMENT: "{}", **(experiments[0] if experiments else {}), **maps[0]["data"]}
    return LinkParts(release.name, maps[0]["metadata"]["name"], files, pods)


def _running_pods(found: list[Any]) -> dict[str, str]:
    """Return component -> name of its newest running pod, from the answer of kubectl."""
    pods = [
        each
        for each in found
        if each["kind"] == "Pod"
        and each["status"].get("phase") == "Running"
        and "deletionTimestamp" not in each["metadata"]
    ]
    # The newest pod comes last, and replaces older pods in the dictionary.
    pods.sort(key=lambda pod: str(pod["metadata"]["creationTimestamp"]))
    return {pod["metadata"]["labels"].get(COMPONENT): pod["metadata"]["name"] for pod in pods}


CARRIER = """\
import socket, sys
link = socket.socket(socket.AF_UNIX)
try:
    link.connect(sys.argv[1])
except OSError as error:
    sys.exit(f"error: no link answers here: {error};")
link.sendall(sys.stdin.buffer.read())
link.shutdown(socket.SHUT_WR)
while data := link.recv(65536):
    sys.stdout.buffer.write(data)
"""
"""Program for Python in a link container: carries its input to a Unix socket, the answer back."""


def ask(release: Release, pod: str, request: bytes) -> LinkState:
    """Send a request to the link container of a pod; return the state of its direction.

    Raise a ValueError or a RejectedError as `read_answer`, a ClusterError if kubectl fails.
    """
    words = ["python", "-I", "-S", "-c", CARRIER, f"{FOLDER}/{SOCKET}"]
    command = [*release.flags, "exec", "--stdin", pod, "--container=link", "--", *words]
    return read_answer(run("kubectl", command, given=request.decode()).encode())


class Sent(NamedTuple):
    """Result of `send`: a changed link profile, and the answers of the two link containers."""

    edit: Edit  # the edited profile
    files: dict[str, str]  # for the ConfigMap
    states: list[LinkState]  # of the containers that have answered, after the change
    failed: list[CloudrcError]  # of the containers that have not answered


def send(
    release: Release, link: LinkParts, profile: str | None, settings: Sequence[str], number: str
) -> Sent:
    """Change the profile in both link containers, and wait until both have applied the change.

    `profile` and `settings` are those of `cloudrc.config.load.edit_profile`. `number` identifies
    the change. Raise a RejectedError if a container does not take it.
    """
    edit, files = with_files(link.files, profile, settings)
    files[CHANGE_FILE] = write_change(ChangeFacts(number, edit.cause, edit.restart))
    needed = _needed_files(edit.values, {**link.files, **files})
    request, at = put_request(json.dumps(needed)), [link.pods[each] for each in COMPONENTS]
    with ThreadPoolExecutor(len(COMPONENTS)) as pool:
        answers = list(pool.map(lambda pod: _answer_of(release, pod, request, number), at))
    failed = [answer for answer in answers if isinstance(answer, CloudrcError)]
    states = [answer for answer in answers if isinstance(answer, LinkState)]
    taken = [state for state in states if not state.objection(number)]
    if len(taken) < len(states):
        said = [state.objection(number) for state in states if state not in taken]
        said += [f"the {state.direction} has the change" for state in taken]
        said += [*map(str, failed), "the ConfigMap is unchanged"]
        raise RejectedError("; ".join(said))
    return Sent(edit, files, states, failed)


def _answer_of(release: Release, pod: str, request: bytes, number: str) -> LinkState | CloudrcError:
    """Return the state of a direction that has decided about a change, or why there is none."""
    try:
        state = ask(release, pod, request)
    except CloudrcError as error:
        return error
    except ValueError as error:
        return ClusterError(f"a link container has another version: {error}; upgrade it")
    if state.has_decided(number):
        return state
    return TimedOutError(
        f"the {state.direction} did not apply the change within {APPLY_LIMIT:g} s; see the log "
        f"of the container link of pod {pod}"
    )


def keep(release: Release, link: LinkParts, sent: Sent) -> None:
    """Write a change to the ConfigMap, from which restarted pods read it.

    Raise an error if the write fails, or if a link container did not confirm the change.
    """
    said = list(map(str, sent.failed))
    words = ["patch", "configmap", link.name, "--type=merge", "--patch-file=/dev/stdin"]
    try:
        run("kubectl", [*release.flags, *words], given=json.dumps({"data": sent.files}))
    except CloudrcError as error:
        text = f"the ConfigMap is unchanged, so that restarted pods lose the change: {error}"
        raise ClusterError("; ".join([*said, text])) from None
    if said:
        said.append("the ConfigMap has the change, and the pods apply it within 2 minutes")
        raise type(sent.failed[0])("; ".join(said))


def _needed_files(values: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, str]:
    ways = [value for value in values.values() if isinstance(value, dict)]
    named = {Path(str(way[key])).name for way in ways for key in FILE_READERS if way.get(key)}
    named |= {PROFILE, CHANGE_FILE}
    return {name: text for name, text in files.items() if name in named}


def with_files(
    files: Mapping[str, str], profile: str | None, settings: Sequence[str]
) -> tuple[Edit, dict[str, str]]:
    """Edit the link's profile; return the new profile, and the files that are new or changed.

    `files` maps file names to texts. If `profile` is given, this profile replaces the one in
    `files`. `settings` are texts `key=value`.
    """
    new: dict[str, str] = {}
    with TemporaryDirectory(prefix="cloudrc-") as name:
        folder = Path(name).resolve()
        for key, text in files.items():
            (folder / key).write_text(text, encoding="utf-8")
        present = load_link(folder / PROFILE, folder / EXPERIMENT)
        values = present.model_dump(mode="json", exclude_defaults=True)
        edited = edit_profile(Document(values), profile, settings)
        for way in DIRECTIONS:
            values = edited.values.get(way, {})
            for key in FILE_READERS:
                if values.get(key) is None:
                    continue
                path = Path(values[key])
                values[key] = path.name
                if path.parent != folder:  # a local file, whose name becomes a valid key
                    values[key] = f"{way}-{re.sub('[^-._a-zA-Z0-9]', '_', path.name)}"
                    new[values[key]] = path.read_text(encoding="utf-8-sig")
    size = sum(len(text) for name, text in {**files, **new}.items() if name != EXPERIMENT)
    if size > SIZE_MAX:
        text = f"traces and profile have {size} bytes, a ConfigMap takes {SIZE_MAX}; use a trace"
        raise problem_at("link", f"{text} with fewer rows, for example one per 20 ms")
    return edited, {PROFILE: write_yaml(edited.values), **new}
