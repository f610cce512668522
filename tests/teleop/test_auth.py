"""Who may do what: tokens, and the gate before the API."""

import json
import os
import stat
import subprocess

import pytest

from cloudrc.errors import BadInputError
from cloudrc.teleop import auth
from cloudrc.teleop.auth import Tokens
from tests.teleop.conftest import OPERATOR, READER, connect, running

A_MISSION = {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}
ANOTHER = "another-token-altogether"
WRONG = [
    None,
    "",
    "wrong-token-of-some-length",
    OPERATOR[:-1],
    OPERATOR + "x",
    OPERATOR.upper(),
    "é",
]


def token_folder(folder, **tokens):
    folder.mkdir(exist_ok=True)
    for role, text in tokens.items():
        (folder / role).write_text(text)
        (folder / role).chmod(0o600)
    return folder


@pytest.fixture(scope="module")
def idle():
    with running() as one:
        yield one


# Tokens


@pytest.mark.parametrize(
    ("tokens", "said"),
    [
        ({}, "operator: No such file or directory; make one: "),
        ({"operator": "short"}, "operator: a token is 16 to 512 visible"),
        ({"operator": "two words and more"}, "operator: a token is"),
        ({"operator": "x" * 513}, "operator: a token is"),
        ({"operator": "o" * 16 + "\n" * 4096}, "operator: longer than 4096 .*; remove it and make"),
        ({"operator": "o" * 16, "reader": ""}, "reader: a token is"),
        ({"operator": "o" * 16, "reader": "o" * 16 + "\n"}, "both roles have the same token"),
    ],
)
def test_unusable_tokens_are_refused_and_not_shown(tmp_path, tokens, said):
    with pytest.raises(BadInputError, match=said) as refused:
        Tokens(token_folder(tmp_path / "t", **tokens))
    assert not [text for text in tokens.values() if text and text in str(refused.value)]


def test_a_pipe_in_place_of_a_token_file_is_not_awaited(tmp_path):
    os.mkfifo(tmp_path / "operator")
    with pytest.raises(BadInputError, match="operator: not a file; remove it and make one"):
        Tokens(tmp_path)


def test_the_command_of_the_message_makes_a_private_token(tmp_path, capsys):
    with pytest.raises(BadInputError) as refused:
        Tokens(tmp_path)
    command = str(refused.value).partition("make one: ")[2]
    assert subprocess.run(["sh", "-c", f"umask 022; {command}"]).returncode == 0
    assert stat.S_IMODE((tmp_path / "operator").stat().st_mode) == 0o600
    warnings = []
    Tokens(tmp_path, warnings.append)
    assert warnings == []


@pytest.mark.parametrize(
    ("mode", "owner", "told"),
    [(0o600, 0, False), (0o400, 0, False), (0o640, 0, True), (0o604, 0, True), (0o440, 1, False)],
)
def test_a_token_file_that_others_can_read_is_warned_of(tmp_path, monkeypatch, mode, owner, told):
    """Kubernetes lets the pod's group read a Secret's files, which belong to root."""
    folder = token_folder(tmp_path / "t", operator=OPERATOR, reader=READER)
    (folder / "reader").chmod(mode)
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + owner)
    warnings = []
    Tokens(folder, warnings.append)
    path = folder / "reader"
    expected = [f"warning: {path} can be read by others: chmod 600 {path}"]
    assert warnings == (expected if told else [])


def test_no_token_is_held_or_shown(tmp_path):
    tokens = Tokens(token_folder(tmp_path / "t", operator=OPERATOR, reader=READER))
    caller = tokens.caller(OPERATOR)
    assert (caller.role, len(caller.name)) == ("operator", len("operator-") + 8)
    for shown in (repr(tokens), repr(vars(tokens)), repr(caller)):
        assert OPERATOR not in shown
        assert READER not in shown


def test_each_token_is_compared_in_constant_time(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(auth.hmac, "compare_digest", lambda a, b: seen.append((a, b)) or a == b)
    tokens = Tokens(token_folder(tmp_path / "t", operator=OPERATOR, reader=READER))
    for token in (OPERATOR, READER, OPERATOR[:-1] + "x", "x" * 500):
        seen.clear()
        tokens.caller(token)
        assert [(len(a), len(b)) for a, b in seen] == [(32, 32)] * 2  # digests, both, each time


def test_tokens_are_followed_when_they_change(tmp_path, monkeypatch):
    assert auth.READ_PERIOD <= 2.0
    monkeypatch.setattr(auth, "READ_PERIOD", 0.0)
    folder = token_folder(tmp_path / "t", operator=OPERATOR, reader=READER)
    tokens = Tokens(folder)
    assert (tokens.caller(OPERATOR).role, tokens.caller(ANOTHER)) == ("operator", None)
    (folder / "operator").write_text(ANOTHER)
    assert (tokens.caller(OPERATOR), tokens.caller(ANOTHER).role) == (None, "operator")
    (folder / "reader").unlink()
    assert tokens.caller(READER) is None
    for unusable in ("short", ""):
        (folder / "operator").write_text(unusable)
        assert tokens.caller(ANOTHER) is None  # an unusable file admits nobody
    (folder / "operator").write_text(OPERATOR)
    assert tokens.caller(OPERATOR).role == "operator"


# The gate


def routes(api):
    """Every route that there is, and some that there are not."""
    for path, verbs in api.get("/openapi.json")["paths"].items():
        yield from ((verb.upper(), path.replace("{id}", "m1")) for verb in verbs)
    for path in ("/", "/openapi.json", "/docs", "/v1", "/v1/estop/", "/v1/missions/../state"):
        yield from ((verb, path) for verb in ("GET", "POST", "PUT", "DELETE", "OPTIONS", "TRACE"))


def effects(api):
    return api.flight.kept.copy(), len(api.flight.requests), len(api.alarms)


@pytest.mark.promise("api-needs-a-token")
@pytest.mark.parametrize("token", WRONG)
def test_without_a_valid_token_every_route_answers_401(idle, token):
    before = effects(idle)
    for method, path in routes(idle):
        headers = {} if token is None else {"Authorization": f"Bearer {token}".encode("latin1")}
        data = None if method == "GET" else json.dumps(A_MISSION).encode()
        status, answer = idle.send(idle.request(path, data, None, method, headers))
        assert (status, list(answer)) == (401, ["detail"]), (method, path)
    assert effects(idle) == before


@pytest.mark.promise("api-needs-a-token")
@pytest.mark.parametrize("scheme", ["", "Basic ", "Bearer", "Token ", "Bearer x "])
def test_only_the_bearer_scheme_is_known(idle, scheme):
    headers = {"Authorization": f"{scheme}{OPERATOR}"}
    assert idle.send(idle.request("/v1/state", headers=headers, token=None))[0] == 401


def test_the_bearer_scheme_ignores_case_and_is_announced(idle):
    request = idle.request("/v1/state", headers={"Authorization": f"bEARER {OPERATOR}"}, token=None)
    assert idle.send(request)[0] == 200
    with connect(idle) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        assert b"www-authenticate: Bearer" in connection.recv(4096)


@pytest.mark.promise("api-needs-a-token")
def test_a_reader_may_look_and_nothing_else(idle):
    before = effects(idle)
    for method, path in routes(idle):
        if "events" in path:
            continue
        data = None if method == "GET" else json.dumps(A_MISSION).encode()
        status, _ = idle.send(idle.request(path, data, READER, method))
        assert status in ((200, 404, 405) if method == "GET" else (403,)), (method, path)
    assert effects(idle) == before
