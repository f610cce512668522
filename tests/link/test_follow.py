"""A ConfigMap's file, a change that is handed over, and a name whose address changes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from cloudrc.cli.link_run import make_profile_loader
from cloudrc.errors import BadInputError
from cloudrc.link.follow import (
    HANDED_FILE,
    SIZE_MAX,
    Handed,
    Loaded,
    PeerName,
    ProfileFile,
    Profiles,
    read_handed,
    write_handed,
)
from cloudrc.link.state import Change, publish


class ConfigMap:
    """A folder as the kubelet mounts it: profile.yaml > ..data/profile.yaml, ..data > a version."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._version = 0
        self.file = folder / "profile.yaml"
        self.file.symlink_to("..data/profile.yaml")

    def put(self, text: str) -> None:
        self._version += 1
        version = self._folder / f"..version_{self._version}"
        version.mkdir()
        (version / "profile.yaml").write_text(text)
        os.utime(version / "profile.yaml", ns=(0, 0))  # the time alone tells nothing
        (self._folder / "..data_tmp").symlink_to(version.name)
        (self._folder / "..data_tmp").replace(self._folder / "..data")


@pytest.fixture
def config_map(tmp_path: Path) -> ConfigMap:
    return ConfigMap(tmp_path)


def follow(config_map: ConfigMap) -> tuple[ProfileFile, list[str]]:
    log: list[str] = []
    return ProfileFile(config_map.file, make_profile_loader("uplink"), log.append), log


def test_a_swapped_config_map_is_read_once(config_map: ConfigMap) -> None:
    config_map.put("uplink: {delay_ms: 40}\n")
    file, _ = follow(config_map)
    assert file.first().direction.delay == pytest.approx(0.04)
    assert file.poll() is None
    config_map.put("{description: new, uplink: {delay_ms: 70}}\n")
    loaded = file.poll()
    assert loaded is not None
    assert loaded.direction.delay == pytest.approx(0.07)
    assert loaded.values == {"description": "new", "uplink": {"delay_ms": 70.0}}
    assert file.poll() is None


@pytest.mark.parametrize(
    ("text", "change"),
    [
        ('{"number": "a1", "cause": "by hand", "restart": false}', Change("a1", "by hand", False)),
        ("{", Change()),
        ('{"number": "a1"}', Change()),
    ],
)
def test_the_note_beside_the_profile_says_who_changed_it(
    config_map: ConfigMap, text: str, change: Change
) -> None:
    config_map.put("uplink: {delay_ms: 40}\n")
    file, _ = follow(config_map)
    assert file.first().change == Change()
    config_map.file.with_name("change.json").write_text(text)
    config_map.put("uplink: {delay_ms: 50}\n")
    loaded = file.poll()
    assert loaded is not None
    assert loaded.change == change


def test_an_invalid_file_is_refused_in_one_line_until_fixed(config_map: ConfigMap) -> None:
    file, log = follow(config_map)
    with pytest.raises(BadInputError, match="no such file"):
        file.first()
    for text in ("uplink: {delay: 40}\n", "uplink: {delay_ms: -1}\n", "a: [\n"):
        config_map.put(text)
        assert file.poll() is None
        assert file.poll() is None
    assert len(log) == 3
    (config_map.file.parent / "..data").unlink()
    assert file.poll() is None
    assert all(line.startswith("the new profile is refused, the old one stays") for line in log)
    config_map.put("uplink: {delay_ms: 50}\n")
    assert file.poll() is not None


def test_a_file_written_during_a_read_is_read_again(tmp_path: Path) -> None:
    place, log = tmp_path / "profile.yaml", list[str]()
    halves = ["", "uplink: {delay_ms: 12}\n", "uplink: {delay_ms: 120}\n"]
    load = make_profile_loader("uplink")

    def load_while_written(path: Path) -> Loaded:
        """Load as if an editor emptied the file first."""
        try:
            return load(path)
        finally:
            if halves:
                place.write_text(halves.pop(0))

    place.write_text("uplink: {delay_ms: 60}\n")
    file = ProfileFile(place, load_while_written, log.append)
    file.first()
    read = [file.poll() for _ in range(5)]
    assert [one.direction.delay for one in read if one] == [pytest.approx(0.12)]
    assert log == []


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
        paths = self.map / "profile.yaml", self.run / HANDED_FILE
        self.profiles = Profiles(*paths, make_profile_loader("uplink"), self.log.append)

    def put(self, delay_ms: float, number: str) -> None:
        if number:
            publish(self.map / "change.json", note(number))
        publish(self.map / "profile.yaml", up(delay_ms))

    def hand(self, delay_ms: float, number: str) -> None:
        document = Handed(note(number), {"profile.yaml": up(delay_ms)})
        publish(self.run / HANDED_FILE, write_handed(document))

    def first(self) -> float:
        return self.profiles.first().direction.delay

    def poll(self) -> tuple[float, str] | None:
        loaded = self.profiles.poll()
        return None if loaded is None else (loaded.direction.delay, loaded.change.number)


@pytest.fixture
def pod(tmp_path: Path) -> Pod:
    return Pod(tmp_path)


@pytest.mark.parametrize("faster", ["hand", "put"])
def test_a_change_that_comes_both_ways_takes_effect_once(pod: Pod, faster: str) -> None:
    assert pod.first() == 0.04
    ways = [pod.hand, pod.put] if faster == "hand" else [pod.put, pod.hand]
    ways[0](120.0, "a1")
    assert pod.poll() == (0.12, "a1")
    assert pod.poll() is None
    ways[1](120.0, "a1")
    assert pod.poll() is None
    assert set(os.listdir(pod.run)) == {HANDED_FILE}, "nothing else is left behind"


def test_a_late_config_map_does_not_bring_an_older_change_back(pod: Pod) -> None:
    pod.first()
    for delay_ms, number in ((120.0, "a1"), (20.0, "b2")):
        pod.hand(delay_ms, number)
        assert pod.poll() == (delay_ms * 1e-3, number)
    for delay_ms, number in ((120.0, "a1"), (20.0, "b2")):
        pod.put(delay_ms, number)
        assert pod.poll() is None


def test_an_upgrade_after_a_change_by_hand_takes_effect(pod: Pod) -> None:
    """Helm puts the profile back and leaves the note of who changed it."""
    pod.first()
    pod.put(120.0, "a1")
    assert pod.poll() == (0.12, "a1")
    pod.put(45.0, "")
    assert pod.poll() == (0.045, "a1")


def test_a_container_that_restarts_takes_the_config_map(pod: Pod) -> None:
    pod.hand(9.0, "refused-by-netem")
    pod.put(120.0, "a1")
    pod.start()
    assert pod.first() == 0.12
    assert pod.poll() is None


def test_a_trace_is_read_beside_the_handed_profile(pod: Pod) -> None:
    pod.first()
    files = {"profile.yaml": "uplink: {trace: t.csv}\n", "t.csv": "time_s,delay_ms\n0,40\n1,60\n"}
    document = Handed(note("a1"), files)
    assert read_handed(write_handed(document)) == document
    publish(pod.run / HANDED_FILE, write_handed(document))
    loaded = pod.profiles.poll()
    assert loaded is not None
    assert loaded.direction.trace is not None
    assert loaded.direction.trace.delays == (0.04, 0.06)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"change": ""}',
        '{"change": "", "files": {}}',
        '{"change": "", "files": {"profile.yaml": "", "../route": "1.2.3.4:5"}}',
        '{"change": "", "files": {"profile.yaml": "", ".link.json": ""}}',
        '{"change": "", "files": {"profile.yaml": "uplink: {delay_ms: -1}"}}',
        '{"change": "", "files": {"profile.yaml": "uplink: {trace: none.csv}"}}',
        '{"change": "", "files": {"profile.yaml": ""}}' + " " * SIZE_MAX,
    ],
)
def test_an_invalid_document_is_refused_in_one_line(pod: Pod, text: str) -> None:
    assert pod.first() == 0.04
    publish(pod.run / HANDED_FILE, text)
    assert pod.poll() is None
    assert pod.poll() is None
    (line,) = pod.log
    assert "refused" in line
    assert os.listdir(pod.run) == [HANDED_FILE]


def test_a_document_of_another_user_is_refused(pod: Pod, monkeypatch: pytest.MonkeyPatch) -> None:
    pod.first()
    pod.hand(120.0, "a1")
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert pod.poll() is None
    assert "belongs to another user" in pod.log[0]


class Names:
    def __init__(self) -> None:
        self.answer: list[str] | OSError = OSError(-2, "Name or service not known")

    def __call__(self, name: str) -> list[str]:
        assert name == "demo-cloud"
        if isinstance(self.answer, OSError):
            raise self.answer
        return self.answer


def test_the_last_address_stays_while_there_is_no_answer() -> None:
    names, log = Names(), list[str]()
    peer = PeerName(("demo-cloud", 7400), names, log.append)
    none = names.answer
    assert [peer.poll(), peer.poll()] == [None, None]
    names.answer = ["10.244.0.7"]
    assert [peer.poll(), peer.poll()] == [("10.244.0.7", 7400)] * 2
    names.answer = none
    assert [peer.poll(), peer.poll()] == [("10.244.0.7", 7400)] * 2
    names.answer = ["10.244.0.9"]
    assert peer.poll() == ("10.244.0.9", 7400)
    assert peer.failures == 4
    assert log == [
        "demo-cloud cannot be resolved (Name or service not known); waits for it",
        "demo-cloud is 10.244.0.7",
        "demo-cloud cannot be resolved (Name or service not known); keeps 10.244.0.7",
        "demo-cloud is 10.244.0.9, was 10.244.0.7",
    ]


def test_of_two_pods_the_newer_is_the_peer() -> None:
    names, log = Names(), list[str]()
    peer = PeerName(("demo-cloud", 7400), names, log.append)
    chosen = []
    for answer in (["b"], ["a", "b"], ["b", "a"], ["a", "b", "c"], ["a"], ["a", "b"]):
        names.answer = answer
        chosen.append((peer.poll() or ("", 0))[0])
    assert chosen == ["b", "a", "a", "c", "a", "b"]
    assert len(log) == 5
