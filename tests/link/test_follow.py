"""Changes of a profile, by ConfigMap and by a request, and of the peer's address."""

import json
import os
from pathlib import Path

import pytest

from cloudrc.errors import BadInputError
from cloudrc.files import write_atomically
from cloudrc.link.follow import PeerName, Profiles
from cloudrc.link.state import ChangeFacts
from cloudrc.processes.link import make_profile_loader

LOAD = make_profile_loader("uplink", Path("none.yaml"))


def note(number):
    return json.dumps({"number": number, "cause": f"cause {number}", "restart": False})


class Pod:
    """The two folders of a link container: that of the ConfigMap and that of the route file."""

    def __init__(self, folder):
        self.map, self.run, self.log = folder / "map", folder / "run", []
        self.map.mkdir()
        self.run.mkdir()
        self.put(40.0, "")
        self.start()

    def start(self):
        self.profiles = Profiles(self.map / "profile.yaml", LOAD, self.log.append)

    def put(self, delay_ms, number):
        if number:
            write_atomically(self.map / "change.json", note(number).encode())
        self.write(f"uplink: {{delay_ms: {delay_ms}}}\n")

    def write(self, text):
        write_atomically(self.map / "profile.yaml", text.encode())
        os.utime(self.map / "profile.yaml", ns=(0, 0))  # the time alone tells nothing

    def hand(self, delay_ms, number):
        profile = f"uplink: {{delay_ms: {delay_ms}}}\n"
        document = json.dumps({"change.json": note(number), "profile.yaml": profile})
        return self.take(document)

    def take(self, document):
        return self.profiles.take(document.encode(), self.run)

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
    pod.put(70.0, "")
    assert pod.poll() == (70.0, "")
    for text in ("uplink: {delay: 40}\n", "uplink: {delay_ms: -1}\n", "a: [\n"):
        pod.write(text)
        assert pod.poll() is pod.poll() is None
    (pod.map / "profile.yaml").unlink()
    assert pod.poll() is pod.poll() is None
    assert len(pod.log) == 4
    assert all(line.startswith("the new profile is refused, the old one stays") for line in pod.log)
    with pytest.raises(BadInputError, match=r"profile\.yaml: No such file"):
        pod.profiles.first()
    pod.put(50.0, "")
    assert pod.poll() == (50.0, "")


def test_a_change_that_comes_both_ways_takes_effect_once(pod):
    assert pod.first() == 40.0
    loaded = pod.hand(120.0, "a1")
    assert loaded.direction.delay_ms == 120.0
    assert loaded.change == ChangeFacts("a1", "cause a1", False)
    pod.put(120.0, "a1")
    assert pod.poll() is None
    assert os.listdir(pod.run) == [], "nothing is left behind"


def test_a_late_config_map_does_not_bring_an_older_change_back(pod):
    pod.first()
    for delay_ms, number in ((120.0, "a1"), (20.0, "b2")):
        assert pod.hand(delay_ms, number).direction.delay_ms == delay_ms
    for delay_ms, number in ((120.0, "a1"), (20.0, "b2")):
        pod.put(delay_ms, number)
        assert pod.poll() is None
    pod.hand(9.0, "refused by netem")
    pod.start()  # a container that restarts takes the ConfigMap
    assert pod.first() == 20.0
    assert pod.poll() is None


def test_an_upgrade_after_a_change_by_hand_takes_effect(pod):
    """Helm restores the profile and leaves the file of the last change, which may be invalid."""
    pod.first()
    pod.put(120.0, "a1")
    assert pod.poll() == (120.0, "a1")
    pod.put(45.0, "")
    assert pod.poll() == (45.0, "")
    write_atomically(pod.map / "change.json", b'{"number": "a2"}')
    pod.put(50.0, "")
    assert pod.poll() == (50.0, "")


def test_a_change_can_contain_a_trace(pod):
    pod.first()
    files = {"profile.yaml": "uplink: {trace: t.csv}\n", "t.csv": "time_s,delay_ms\n0,40\n1,60\n"}
    files["change.json"] = note("a1")
    assert pod.take(json.dumps(files)).direction.rows.delays == (0.04, 0.06)
    for name, text in files.items():  # the same change, in the folder of the ConfigMap
        write_atomically(pod.map / name, text.encode())
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
