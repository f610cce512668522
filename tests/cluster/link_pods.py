"""A pretended kubectl: what a release's link is told goes in, what its containers say comes out."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cloudrc.link.state import LinkState, from_text

PROFILE = "uplink: {delay_ms: 45, jitter_ms: 25}\ndownlink: {delay_ms: 45, jitter_ms: 25}\n"
TRACE = "time_s,delay_ms\n0,40\n1,60\n"
LABEL = "app.kubernetes.io/component"
KUBECTL = """
import json, pathlib, sys
folder, words = pathlib.Path(sys.argv[1]), sys.argv[2:]
verb = next(word for word in words if word in ("get", "patch", "exec"))
with (folder / "asked").open("a") as asked:
    print(" ".join(" ".join(words).split()), file=asked)
refused = folder / f"refuse-{verb}"
if refused.exists():
    sys.exit(refused.read_text())
if verb == "get":
    print((folder / "items.json").read_text())
elif verb == "patch":
    (folder / "patched.json").write_text(sys.stdin.read())
else:
    pod = words[words.index("exec") + 2]
    broken, number = folder / f"broken-{pod}", str(len(list(folder.glob(f"handed-{pod}-*"))))
    if broken.exists() and broken.read_text() in ("", number):
        sys.exit("Error from server: the pod is gone")
    document = json.loads(sys.stdin.read())
    (folder / f"handed-{pod}-{number}.json").write_text(json.dumps(document))
    change = json.loads(document["change"])
    place = folder / f"state-{pod}.json"
    state, cannot = json.loads(place.read_text()), folder / f"cannot-{pod}"
    if cannot.exists() and cannot.read_text() in document["files"]["profile.yaml"]:
        state |= {"refused": change["number"], "refusal": "netem cannot do that"}
    elif not (folder / f"deaf-{pod}").exists():
        state |= {"change": change["number"], "cause": change["cause"]}
    place.write_text(json.dumps(state))
    print(json.dumps(state))
"""


def item(kind: str, name: str, component: str, **rest: Any) -> dict[str, Any]:
    stamp = "2026-01-01T00:00:00Z"
    metadata = {"name": name, "labels": {LABEL: component}, "creationTimestamp": stamp}
    return {"kind": kind, "metadata": metadata, **rest}


class Cluster:
    """What the pretended kubectl knows, and what it was asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        running = {"status": {"phase": "Running"}}
        self.items = [
            item("ConfigMap", "demo-link", "link", data={"profile.yaml": PROFILE}),
            item("ConfigMap", "demo-experiment", "shared", data={"experiment.yaml": "{}"}),
            item("Pod", "world-1", "world", **running),
            item("Pod", "cloud-1", "cloud", **running),
            item("Pod", "cloud-0", "cloud", **running),
        ]
        self.items[-1]["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:01Z"
        for pod, way in (("world-1", "uplink"), ("cloud-1", "downlink")):
            asked = {"delay": 0.12}
            state = asdict(LinkState("netem", "", "auto", way, {}, "", 1, asked=asked))
            (folder / f"state-{pod}.json").write_text(json.dumps(state))
        self.tell()

    def tell(self) -> None:
        (self.folder / "items.json").write_text(json.dumps({"items": self.items}))

    def refuse(self, verb: str, text: str) -> None:
        (self.folder / f"refuse-{verb}").write_text(text)

    def patched(self) -> dict[str, str]:
        data: dict[str, str] = json.loads((self.folder / "patched.json").read_text())["data"]
        return data

    def make(self, what: str, pod: str, how: str = "") -> None:
        """Let a pod be `deaf`; `broken` (at its Nth call); or one that `cannot` do a word."""
        (self.folder / f"{what}-{pod}").write_text(how)

    def handed(self, pod: str) -> list[dict[str, Any]]:
        """What a pod was given, the newest last."""
        paths = sorted(self.folder.glob(f"handed-{pod}-*.json"))
        return [json.loads(path.read_text()) for path in paths]

    def state(self, pod: str) -> LinkState:
        return from_text((self.folder / f"state-{pod}.json").read_text())

    def kept(self) -> bool:
        """Whether the ConfigMap was written."""
        return (self.folder / "patched.json").exists()

    def asked(self) -> list[str]:
        """All command lines of kubectl."""
        return (self.folder / "asked").read_text().splitlines()


def pretended(folder: Path, pretend: Callable[[str, str], Path]) -> Cluster:
    """Put a release and its kubectl into a folder."""
    script = folder / "kubectl.py"
    script.write_text(KUBECTL)
    pretend("kubectl", f'exec {sys.executable} -S {script} {folder} "$@"')
    return Cluster(folder)
