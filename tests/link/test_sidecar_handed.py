"""A change comes to the sidecar by hand and by the ConfigMap: it takes force once, by the first."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from cloudrc.cli.link_run import make_profile_loader
from cloudrc.link.follow import (
    HANDED_FILE,
    SIZE_MAX,
    Handed,
    HandedProfile,
    ProfileFile,
    Profiles,
    read_handed,
    write_handed,
)
from cloudrc.link.state import publish


def note(number: str) -> str:
    return json.dumps({"number": number, "cause": f"cause {number}", "restart": True})


def up(delay_ms: float) -> str:
    return f"uplink: {{delay_ms: {delay_ms}}}\n"


class Pod:
    """The two folders of a link container: the ConfigMap's, and the one beside the route."""

    def __init__(self, folder: Path) -> None:
        self.map, self.run, self.log = folder / "map", folder / "run", list[str]()
        self.map.mkdir()
        self.run.mkdir()
        self.put(40.0, "")
        self.start()

    def start(self) -> None:
        load = make_profile_loader("uplink")
        file = ProfileFile(self.map / "profile.yaml", load, self.log.append)
        handed = HandedProfile(self.run / HANDED_FILE, load, self.log.append)
        self.profiles = Profiles(file, handed)

    def put(self, delay_ms: float, number: str) -> None:
        if number:
            publish(self.map / "change.json", note(number))
        publish(self.map / "profile.yaml", up(delay_ms))

    def hand(self, delay_ms: float, number: str, after: str = "") -> None:
        document = Handed(note(number), after, {"profile.yaml": up(delay_ms)})
        publish(self.run / HANDED_FILE, write_handed(document))

    def first(self) -> float:
        return self.profiles.first().direction.delay

    def poll(self) -> tuple[float, str] | None:
        loaded = self.profiles.poll()
        return None if loaded is None else (loaded.direction.delay, loaded.change.number)


@pytest.fixture
def pod(tmp_path: Path) -> Pod:
    return Pod(tmp_path)


def test_a_handed_change_acts_and_the_config_map_adds_none(pod: Pod) -> None:
    assert pod.first() == 0.04
    pod.hand(120.0, "a1")
    assert pod.poll() == (0.12, "a1")
    assert pod.poll() is None
    pod.put(120.0, "a1")
    assert pod.poll() is None
    assert os.listdir(pod.run) == [HANDED_FILE], "nothing is left behind"


def test_a_faster_config_map_is_not_applied_twice(pod: Pod) -> None:
    pod.first()
    pod.put(120.0, "a1")
    assert pod.poll() == (0.12, "a1")
    pod.hand(120.0, "a1")
    assert pod.poll() is None


def test_a_late_config_map_does_not_bring_the_change_before_back(pod: Pod) -> None:
    pod.first()
    pod.hand(120.0, "a1")
    assert pod.poll() == (0.12, "a1")
    pod.hand(20.0, "b2", "a1")
    assert pod.poll() == (0.02, "b2")
    pod.put(120.0, "a1")
    assert pod.poll() is None
    pod.put(20.0, "b2")
    assert pod.poll() is None


def test_an_upgrade_after_a_change_by_hand_takes_force(pod: Pod) -> None:
    """Helm puts the profile back and leaves the note of who changed it."""
    pod.first()
    pod.hand(120.0, "a1")
    pod.poll()
    pod.put(120.0, "a1")
    pod.poll()
    pod.put(45.0, "")
    assert pod.poll() == (0.045, "a1")


@pytest.mark.parametrize(
    ("in_map", "delay"), [("", 0.12), ("a1", 0.12), ("c3", 0.07)], ids=["stale", "same", "newer"]
)
def test_a_container_that_starts_again_takes_the_newer_of_both(
    pod: Pod, in_map: str, delay: float
) -> None:
    pod.hand(120.0, "a1")
    pod.put({"": 40.0, "a1": 120.0, "c3": 70.0}[in_map], in_map)
    pod.start()
    assert pod.first() == delay
    pod.put(120.0 if delay == 0.12 else 70.0, in_map or "a1")
    assert pod.poll() is None


def test_a_trace_is_read_beside_the_profile_that_was_handed_over(pod: Pod) -> None:
    pod.first()
    files = {"profile.yaml": "uplink: {trace: t.csv}\n", "t.csv": "time_s,delay_ms\n0,40\n1,60\n"}
    publish(pod.run / HANDED_FILE, write_handed(Handed(note("a1"), "", files)))
    loaded = pod.profiles.poll()
    assert loaded is not None
    assert loaded.direction.trace is not None
    assert loaded.direction.trace.delays == (0.04, 0.06)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"change": "", "after": ""}',
        '{"change": "", "after": "", "files": {}}',
        '{"change": "", "after": "", "files": {"profile.yaml": "", "../route": "1.2.3.4:5"}}',
        '{"change": "", "after": "", "files": {"profile.yaml": "", ".link.json": ""}}',
        '{"change": "", "after": "", "files": {"profile.yaml": "uplink: {delay_ms: -1}"}}',
        '{"change": "", "after": "", "files": {"profile.yaml": "uplink: {trace: none.csv}"}}',
        " " * 1_300_000,
    ],
)
def test_what_is_no_profile_is_refused_in_one_line(pod: Pod, text: str) -> None:
    assert pod.first() == 0.04
    publish(pod.run / HANDED_FILE, text)
    assert pod.poll() is None
    assert pod.poll() is None
    (line,) = pod.log
    assert "refused" in line
    assert os.listdir(pod.run) == [HANDED_FILE]


def test_a_document_that_is_too_long_is_refused_and_not_cut(pod: Pod) -> None:
    pod.first()
    whole = write_handed(Handed(note("a1"), "", {"profile.yaml": up(120.0)}))
    publish(pod.run / HANDED_FILE, whole.ljust(SIZE_MAX + 1))
    assert pod.poll() is None
    assert "it is too long" in pod.log[0]
    publish(pod.run / HANDED_FILE, whole.ljust(SIZE_MAX))
    assert pod.poll() == (0.12, "a1")


def test_a_link_or_somebody_elses_file_is_refused(
    pod: Pod, monkeypatch: pytest.MonkeyPatch
) -> None:
    pod.first()
    pod.hand(120.0, "a1")
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert pod.poll() is None
    assert "it is somebody else's" in pod.log[0]
    monkeypatch.undo()
    document = pod.run / HANDED_FILE
    document.rename(pod.map / "elsewhere")
    document.symlink_to(pod.map / "elsewhere")
    assert pod.poll() is None
    assert len(pod.log) == 2


def test_a_document_is_written_and_read_again() -> None:
    document = Handed(note("a1"), "b2", {"profile.yaml": up(1.0), "t.csv": "x"})
    assert read_handed(write_handed(document)) == document
