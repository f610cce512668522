"""The audit log: who commanded what, on a disk that may be slow, full or missing."""

import errno
import io
import json
import stat
import threading
import time

from cloudrc.teleop import server
from tests.teleop.conftest import OPERATOR, READER, running

A_MISSION = {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}


def test_commands_are_audited_with_who_and_what_became_of_them():
    with running() as api:
        api.post("/v1/missions", {**A_MISSION, "key": "uid"})
        api.post("/v1/missions", A_MISSION)
        api.post("/v1/hold", token=READER)
        api.post("/v1/hold", token="a-wrong-token-of-some-length")
        api.get("/v1/state")
        api.post("/v1/estop")
        lines = api.audited()
        text = api.audit_file.read_text()
        assert stat.S_IMODE(api.audit_file.stat().st_mode) == 0o600
    assert [(w["role"], w["action"], w["mission"], w["status"]) for w in lines] == [
        ("operator", "POST /v1/missions", "m1", 201),
        ("operator", "POST /v1/missions", "m1", 409),
        ("reader", "POST /v1/hold", None, 403),
        ("operator", "POST /v1/estop", "m1", 200),
    ]
    assert "cancel it first" in lines[1]["outcome"]
    assert {w["client"].partition(":")[0] for w in lines} == {"127.0.0.1"}
    assert all(w["time"].endswith("+00:00") for w in lines)
    assert OPERATOR not in text
    assert READER not in text


def test_what_a_reader_is_refused_displaces_no_command(monkeypatch):
    monkeypatch.setattr(server, "REFUSALS_NOTED", (0.0, 2))
    with running() as api:
        api.post("/v1/estop")
        for _ in range(5):
            assert api.post("/v1/hold", token=READER)[0] == 403
        api.post("/v1/estop")
        for _ in range(4):
            assert api.post("/v1/hold", token=READER)[0] == 403
        lines = api.audited()
    who = [(w.get("role"), w.get("left_out")) for w in lines]
    refused = ("reader", None)
    assert who == [
        *[("operator", None), refused, refused],
        *[(None, 3), ("operator", None), (None, 4)],  # and what is left to say at the end
    ]


def test_the_audit_log_rotates_and_reports_a_bad_disk_once(tmp_path):
    from cloudrc.teleop.auth import Audit

    path = tmp_path / "audit.jsonl"
    audit = Audit(path, size_max=100)
    for number in range(20):
        audit.note(number=number)
        time.sleep(0.002)
    audit.close()
    assert path.with_name("audit.jsonl.1").exists()
    said = []
    audit = Audit(tmp_path / "no" / "folder", said.append)
    for _ in range(3):
        audit.note(number=1)
        time.sleep(0.01)
    audit.close()
    assert audit.dropped == 3
    (complaint,) = said
    assert "No such file or directory" in complaint


def test_an_audit_log_that_cannot_be_renamed_has_no_more_room(tmp_path):
    from cloudrc.teleop.auth import Audit

    path, said = tmp_path / "audit.jsonl", []
    path.with_name("audit.jsonl.1").mkdir()
    audit = Audit(path, said.append, size_max=100)
    for number in range(20):
        audit.note(number=number)
        while not audit._waiting.empty():
            time.sleep(0.001)
    audit.close()
    assert len(path.read_text().splitlines()) == 20 - audit.dropped
    assert path.stat().st_size < 300
    (complaint,) = said
    assert "Is a directory" in complaint


def test_what_a_slow_disk_makes_too_many_is_dropped_and_counted(tmp_path, monkeypatch):
    from cloudrc.teleop import auth

    monkeypatch.setattr(auth, "WAITING_MAX", 2)
    monkeypatch.setattr(auth.Audit, "_write_all", lambda self: None)
    audit = auth.Audit(tmp_path / "audit")
    for _ in range(5):
        audit.note(x=1)
    assert audit.dropped == 3


def test_a_hanging_disk_blocks_no_close_and_drops_are_counted(tmp_path, monkeypatch):
    from cloudrc.teleop import auth

    begun, released = threading.Event(), threading.Event()

    def hang(audit, path, data):
        begun.set()
        released.wait()

    monkeypatch.setattr(auth, "WAITING_MAX", 2)
    monkeypatch.setattr(auth, "STOP_LIMIT", 0.05)
    monkeypatch.setattr(auth.Audit, "_write", hang)
    audit = auth.Audit(tmp_path / "audit")
    audit.note(x=1)
    assert begun.wait(5.0)
    for _ in range(3):
        audit.note(x=1)
    closing = threading.Thread(target=audit.close, daemon=True)
    closing.start()
    closing.join(5.0)
    ended, dropped = not closing.is_alive(), audit.dropped
    released.set()
    assert ended
    assert dropped == 4  # one that is being written, two that wait, one that found no room


def test_what_a_full_disk_tears_swallows_no_other_line(tmp_path, monkeypatch):
    from cloudrc.teleop import auth

    real, left = io.FileIO.write, [50]

    class Full(io.FileIO):
        """A file on a disk that has room for so many bytes."""

        def write(self, data):
            if not left[0]:
                raise OSError(errno.ENOSPC, "No space left on device")
            written = real(self, bytes(data)[: left[0]])
            left[0] -= written
            return written

    def open_full(path, mode, buffering=-1, opener=None):
        raw = Full(path, mode, opener=opener)
        return raw if buffering == 0 else io.BufferedWriter(raw)

    monkeypatch.setattr(auth, "open", open_full, raising=False)
    path = tmp_path / "audit"
    audit = auth.Audit(path)
    audit.close()
    audit._path = path
    for number, room in (1, 10_000), (2, 10), (3, 10_000):
        left[0] = room
        audit.note(number=number)
        audit._waiting.put(None)
        audit._write_all()
    assert [json.loads(line)["number"] for line in path.read_text().splitlines()] == [1, 3]
    assert audit.dropped == 1
