# SPDX-License-Identifier: Apache-2.0

"""Changes of a profile, by ConfigMap and by a request, and of the peer's address."""

import json
import os
from pathlib import Path

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import write_atomically
from cloudrc.flight.pod.link import make_profile_loader
from cloudrc.link.follow import PeerName, Profiles
from cloudrc.link.state import ChangeFacts

LOAD = make_profile_loader("uplink", Path("none.yaml"), 1)


def change(delay_ms, number=""):
    """Return the files of a change, name -> text; without a number only the profile."""
    files = {"profile.yaml": f"uplink: {{delay_ms: {delay_ms}}}\n"}
    if number:
        note = {"number": number, "cause": f"cause {number}", "restart": False}
        files["change.json"] = json.dumps(note)
    return files


class Pod:
    """The two folders of a link container: that of the ConfigMap and that of the route file."""

    def __init__(self, folder):
        self.map, self.run, self.log = folder / "map", folder / "run", []
        self.map.mkdir()
        self.run.mkdir()
        self.put(change(40.0))
        self.start()

    def start(self):
        self.profiles = Profiles(self.map / "profile.yaml", LOAD, self.log.append)

    def put(self, files):
        for name, text in files.items():
            write_atomically(self.map / name, text.encode())
            os.utime(self.map / name, ns=(0, 0))  # the time alone tells nothing

    def take(self, files):
        return self.profiles.take(json.dumps(files).encode(), self.run)

    def first(self):
        return self.profiles.first().direction.delay_ms

    def poll(self):
        loaded = self.profiles.poll()
        return None if loaded is None else (loaded.direction.delay_ms, loaded.change.number)


@pytest.fixture
def pod(tmp_path):
    return Pod(tmp_path)


def test_a_new_file_is_read_once_and_refused_until_fixed(pod):
    assert pod.first() == 40.0
    assert pod.poll() is None
    pod.put(change(70.0))
    assert pod.poll() == (70.0, "")
    for text in ("uplink: {delay: 40}\n", "uplink: {delay_ms: -1}\n", "a: [\n"):
        pod.put({"profile.yaml": text})
        assert pod.poll() is pod.poll() is None
    (pod.map / "profile.yaml").unlink()
    assert pod.poll() is pod.poll() is None
    assert len(pod.log) == 4
    assert all(line.startswith("the new profile is refused, the old one stays") for line in pod.log)
    with pytest.raises(BadInputError, match=r"profile\.yaml: No such file"):
        pod.profiles.first()
    pod.put(change(50.0))
    assert pod.poll() == (50.0, "")


def test_a_change_that_comes_both_ways_takes_effect_once(pod):
    pod.first()
    loaded = pod.take(change(120.0, "a1"))
    assert loaded.direction.delay_ms == 120.0
    assert loaded.change == ChangeFacts("a1", "cause a1", False)
    pod.put(change(120.0, "a1"))
    assert pod.poll() is None
    assert os.listdir(pod.run) == [], "nothing is left behind"


def test_a_late_config_map_does_not_bring_an_older_change_back(pod):
    pod.first()
    changes = change(120.0, "a1"), change(20.0, "b2")
    assert [pod.take(files).direction.delay_ms for files in changes] == [120.0, 20.0]
    for files in changes:
        pod.put(files)
        assert pod.poll() is None
    pod.take(change(9.0, "refused by netem"))
    pod.start()  # a container that restarts takes the ConfigMap
    assert pod.first() == 20.0
    assert pod.poll() is None


def test_an_upgrade_after_a_change_by_hand_takes_effect(pod):
    """Helm restores the profile and leaves the file of the last change, which may be invalid."""
    pod.first()
    pod.put(change(120.0, "a1"))
    assert pod.poll() == (120.0, "a1")
    pod.put(change(45.0))
    assert pod.poll() == (45.0, "")
    pod.put({"change.json": '{"number": "a2"}', **change(50.0)})
    assert pod.poll() == (50.0, "")


def test_a_change_can_contain_a_trace(pod):
    pod.first()
    files = change(0.0, "a1") | {"t.csv": "time_s,delay_ms\n0,40\n1,60\n"}
    files["profile.yaml"] = "uplink: {trace: t.csv}\n"
    assert pod.take(files).direction.rows.delays == (0.04, 0.06)
    pod.put(files)
    again = pod.profiles.poll()
    assert (again.change.number, again.change.restart) == ("a1", False)
    assert again.values["uplink"]["trace"] == str(pod.map / "t.csv")
    assert pod.poll() is None


def test_the_peer_is_the_newest_address_even_without_an_answer():
    """While an old and a new pod overlap, their name has two addresses."""
    log, answers = [], [[], ["b"], ["a", "b"], [], ["b", "a"], ["a", "b", "c"], ["a"]]

    def resolve(name):
        if not (found := answers.pop(0)):
            raise OSError(-2, "Name or service not known")
        return found

    peer = PeerName(("demo-cloud", 7400), resolve, log.append)
    chosen = [peer.poll() for _ in range(7)]
    assert (chosen[:2], peer.failures) == ([None, ("b", 7400)], 2)
    assert [one[0] for one in chosen[2:]] == ["a", "a", "a", "c", "a"]
    failed = "cannot be resolved (Name or service not known); "
    waits, stays = failed + "the link waits", failed + "its last address stays"
    assert log[:4] == [f"demo-cloud {said}" for said in (waits, "is b", "is a", stays)]
