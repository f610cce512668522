"""The audit log: who commanded what, on a disk that may refuse."""

import json
import stat

import pytest

from cloudrc.teleop import audit
from cloudrc.teleop.audit import Audit
from tests.teleop.conftest import OPERATOR, READER, running

A_MISSION = {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}


def command(number):
    return {"method": "POST", "path": f"/{number}", "client": None}


def test_commands_are_audited_with_caller_and_result():
    with running() as api:
        api.post("/v1/missions", {**A_MISSION, "key": "uid"})
        api.post("/v1/missions", A_MISSION)
        api.post("/v1/hold", token=READER)
        api.post("/v1/hold", token="a-wrong-token-of-some-length")
        api.get("/v1/state")
        api.post("/v1/estop/")
        lines = api.audited()
        text = api.audit_file.read_text()
        assert stat.S_IMODE(api.audit_file.stat().st_mode) == 0o600
    assert [(w["role"], w["action"], w["mission"], w["status"]) for w in lines] == [
        ("operator", "POST /v1/missions", "m1", 201),
        ("operator", "POST /v1/missions", "m1", 409),
        ("operator", "POST /v1/estop", "m1", 200),
    ]
    assert "cancel it first" in lines[1]["outcome"]
    assert {w["client"].partition(":")[0] for w in lines} == {"127.0.0.1"}
    assert all(w["time"].endswith("+00:00") for w in lines)
    assert OPERATOR not in text
    assert READER not in text


def test_the_audit_log_has_two_files_of_limited_size(tmp_path, monkeypatch):
    monkeypatch.setattr(audit, "SIZE_MAX", 500)
    path, said = tmp_path / "audit.jsonl", []
    log = Audit(path, said.append)
    for number in range(20):
        log.note("operator", "name", command(number), {"status": 200})
    log.stop()
    kept = [tmp_path / "audit.jsonl.1", path]
    assert sorted(tmp_path.iterdir()) == sorted(kept)
    assert max(file.stat().st_size for file in kept) <= 500
    lines = "".join(file.read_text() for file in kept).splitlines()
    assert json.loads(lines[-1])["action"] == "POST /19"
    assert (log.dropped, said) == (0, [])


@pytest.mark.parametrize("where", ["no/folder", "a folder"])
def test_lines_that_cannot_be_written_are_counted(tmp_path, where):
    (tmp_path / "a folder").mkdir()
    said = []
    log = Audit(tmp_path / where, said.append)
    for number in range(3):
        log.note("operator", "name", command(number), {"status": 200})
    log.stop()
    assert log.dropped == 3
    (complaint,) = said
    assert complaint.startswith(f"the audit log {tmp_path / where} cannot be written: [Errno")
