"""What the sidecar follows: a ConfigMap's file, and a name that means now this pod, now that."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cloudrc.cli.link_run import make_profile_loader
from cloudrc.errors import BadInputError
from cloudrc.link.follow import Loaded, PeerName, ProfileFile
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import Change, DirectionProfile
from cloudrc.link.state import Change as Note
from cloudrc.link.state import publish_route, withdraw


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


def test_the_note_beside_the_profile_says_who_changed_it(config_map: ConfigMap) -> None:
    config_map.put("uplink: {delay_ms: 40}\n")
    file, _ = follow(config_map)
    assert file.first().change == Note()
    note = config_map.file.with_name("change.json")
    for text, change in (
        ('{"number": "a1", "cause": "by hand", "restart": false}', Note("a1", "by hand", False)),
        ("{", Note()),
        ('{"number": "a1"}', Note()),
    ):
        note.write_text(text)
        config_map.put("uplink: {delay_ms: 50}\n")
        loaded = file.poll()
        assert loaded is not None
        assert loaded.change == change


def test_an_invalid_file_is_refused_in_one_line_until_fixed(config_map: ConfigMap) -> None:
    config_map.put("uplink: {delay_ms: 40}\n")
    file, log = follow(config_map)
    file.first()
    for text in ("uplink: {delay: 40}\n", "uplink: {delay_ms: -1}\n", "a: [\n"):
        config_map.put(text)
        assert file.poll() is None
        assert file.poll() is None
    assert len(log) == 3
    assert all(line.startswith("the new profile is refused, the old one stays") for line in log)
    config_map.put("uplink: {delay_ms: 50}\n")
    assert file.poll() is not None


def test_a_file_that_goes_and_comes_back(config_map: ConfigMap) -> None:
    file, log = follow(config_map)
    with pytest.raises(BadInputError, match="no such file"):
        file.first()
    config_map.put("{}\n")
    assert file.poll() is not None
    (config_map.file.parent / "..data").unlink()
    assert file.poll() is None
    assert len(log) == 1


def test_a_file_written_during_a_read_is_read_again(
    tmp_path: Path,
) -> None:
    place, log = tmp_path / "profile.yaml", list[str]()
    halves = ["", "uplink: {delay_ms: 12}\n", "uplink: {delay_ms: 120}\n"]
    load = make_profile_loader("uplink")

    def load_while_written(path: Path) -> Loaded:
        """As an editor does that empties the file first."""
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


def test_a_route_is_whole_or_not_there(tmp_path: Path) -> None:
    route = tmp_path / "route"
    for port in (7401, 7400):
        publish_route(route, ("10.0.0.1", port))
        assert route.read_text() == f"10.0.0.1:{port}\n"
    assert os.listdir(tmp_path) == ["route"]
    withdraw(route)
    withdraw(route)
    assert os.listdir(tmp_path) == []


def test_a_new_time_line_may_count_from_the_next_packet() -> None:
    after = DirectionProfile(0.02, changes=(Change(5.0, delay=0.2),))
    link = LinkDirection(DirectionProfile(0.04), 1, True, 0)
    link.replace_profile(after, restart=True)
    for now, delay in ((7.0, 0.02), (11.9, 0.02), (12.1, 0.2)):
        (release_ns,) = link.send(1, 3, 0, 172, round(now * 1e9))
        assert release_ns == round(now * 1e9) + round(delay * 1e9)


def test_a_link_with_a_new_profile_keeps_seed_origin_and_counts() -> None:
    before, after = (
        DirectionProfile(0.04, 0.01),
        DirectionProfile(
            0.02, 0.01, distribution="normal", loss=0.1, changes=(Change(5.0, delay=0.2),)
        ),
    )
    link, always = LinkDirection(before, 1, True, 100), LinkDirection(after, 1, True, 100)
    for n in range(300):
        link.send(1, 3, n, 172, n)
    link.replace_profile(after)
    for n, now_ns in ((299, 400), (300, 500), (900, 5_000_000_200)):
        assert link.send(1, 3, n, 172, now_ns) == always.send(1, 3, n, 172, now_ns)
    assert link.counts()["passed"] >= 300
