"""Tokens: read from files, followed, kept as digests, compared in constant time, never shown."""

import ast
import json
import os
from pathlib import Path

import pytest

from cloudrc.errors import BadInputError
from cloudrc.teleop import api, auth
from cloudrc.teleop.auth import Tokens
from cloudrc.teleop.store import Order
from tests.teleop.conftest import OPERATOR, READER, SERVICE_PLAN, connect, head, running


def token_folder(folder, **tokens):
    folder.mkdir(exist_ok=True)
    for role, text in tokens.items():
        (folder / role).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("tokens", "said"),
    [
        ({}, "operator: No such file or directory; make one: openssl rand"),
        ({"operator": "short"}, "operator: a token is 16 to 512 visible"),
        ({"operator": "two words and more"}, "operator: a token is"),
        ({"operator": "x" * 513}, "operator: a token is"),
        ({"operator": "o" * 16, "reader": ""}, "reader: a token is"),
        ({"operator": "o" * 16, "reader": "o" * 16 + "\n"}, "both roles have the same token"),
    ],
)
def test_tokens_that_cannot_be_used_are_refused_and_not_shown(tmp_path, tokens, said):
    with pytest.raises(BadInputError, match=said) as refused:
        Tokens(token_folder(tmp_path / "t", **tokens))
    assert not [text for text in tokens.values() if text and text in str(refused.value)]


def spoilt(path, how):
    """In the place of a token file stands what never ends, as a pipe does, or is far too long."""
    path.unlink(missing_ok=True)
    if how == "pipe":
        os.mkfifo(path)
    else:
        path.write_text(OPERATOR + "\n" * auth.TOKEN_SIZE_MAX)


@pytest.mark.parametrize(("how", "said"), [("pipe", "not a file"), ("long", "longer than 4096")])
@pytest.mark.parametrize("role", ["operator", "reader"])
def test_what_is_no_token_file_is_refused_and_not_waited_for(tmp_path, role, how, said):
    folder = token_folder(tmp_path / "t", operator=OPERATOR, reader=READER)
    spoilt(folder / role, how)
    with pytest.raises(BadInputError, match=f"{role}: {said}.*; remove it and make one: openssl"):
        Tokens(folder)


@pytest.mark.parametrize("how", ["pipe", "long"])
def test_what_becomes_no_token_file_in_flight_admits_nobody(tmp_path, monkeypatch, how):
    monkeypatch.setattr(auth, "LOOK_PERIOD", 0.0)
    folder = token_folder(tmp_path / "t", operator=OPERATOR)
    tokens, header = Tokens(folder), f"Bearer {OPERATOR}".encode()
    assert tokens.caller(header).role == "operator"
    spoilt(folder / "operator", how)
    assert tokens.caller(header) is None
    (folder / "operator").unlink()
    token_folder(folder, operator=OPERATOR)
    assert tokens.caller(header).role == "operator"


def test_no_token_is_held_or_shown(tmp_path):
    tokens = Tokens(token_folder(tmp_path / "t", operator=OPERATOR, reader=READER))
    for shown in (repr(tokens), repr(vars(tokens)), str(tokens.caller(b"Bearer x" + b"y" * 20))):
        assert OPERATOR not in shown
        assert READER not in shown
    caller = tokens.caller(f"Bearer {OPERATOR}".encode())
    assert (caller.role, caller.name.startswith("operator-")) == ("operator", True)
    assert len(caller.name) == len("operator-") + 8


def compared_early(source):
    """Lines of `Tokens.caller` that could take less time for a token that is nearly right.

    A digest may be compared by `hmac.compare_digest` alone, with every one that is known: no other
    comparison or look-up of what was given, and no way out of the loop before its end.
    """
    (function,) = (
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef) and node.name == "caller"
    )
    loops = [node for node in ast.walk(function) if isinstance(node, ast.For)]
    compares = [call for call in ast.walk(function) if is_call(call, "hmac.compare_digest")]
    inside = [node for loop in loops for node in ast.walk(loop)]
    leaves = [n for n in inside if isinstance(n, ast.Break | ast.Return | ast.Continue)]
    others = [
        node
        for node in ast.walk(function)
        if isinstance(node, ast.Compare | ast.Subscript)
        and {"given", "digest"} & {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
    ]
    assert [call for call in compares if call in inside] == compares != []
    return [ast.unparse(node) for node in (*leaves, *others)]


def is_call(node, name):
    return isinstance(node, ast.Call) and ast.unparse(node.func) == name


def test_tokens_are_compared_in_constant_time(monkeypatch, tmp_path):
    source = Path(auth.__file__).read_text()
    assert compared_early(source) == []
    for before, after in (
        ("found = caller\n", "found = caller\n                break\n"),
        ("found = caller\n", "return caller\n"),
        ("found = None\n", "found = known[given]\n"),
        ("found = None\n", "found = given == 1\n"),
    ):
        assert before in source
        assert compared_early(source.replace(before, after, 1))
    seen = []
    monkeypatch.setattr(auth.hmac, "compare_digest", lambda a, b: seen.append((a, b)) or a == b)
    tokens = Tokens(token_folder(tmp_path / "t", operator=OPERATOR, reader=READER))
    for token in (OPERATOR, READER, OPERATOR[:-1] + "x", "x" * 500):
        seen.clear()
        tokens.caller(f"Bearer {token}".encode())
        assert [(len(a), len(b)) for a, b in seen] == [(32, 32)] * 2  # digests, both, each time


def test_tokens_are_followed_when_they_change(tmp_path, monkeypatch):
    assert auth.LOOK_PERIOD <= 2.0
    monkeypatch.setattr(auth, "LOOK_PERIOD", 0.0)
    folder = token_folder(tmp_path / "t", operator=OPERATOR, reader=READER)
    tokens = Tokens(folder)
    old, new = f"Bearer {OPERATOR}".encode(), b"Bearer another-token-altogether"
    assert (tokens.caller(old).role, tokens.caller(new)) == ("operator", None)
    (folder / "new").write_text("another-token-altogether")
    (folder / "new").replace(folder / "operator")
    assert (tokens.caller(old), tokens.caller(new).role) == (None, "operator")
    (folder / "reader").unlink()
    assert tokens.caller(f"Bearer {READER}".encode()) is None
    (folder / "operator").unlink()
    assert tokens.caller(new) is None  # what cannot be read admits nobody
    (folder / "operator").write_text(OPERATOR)
    assert tokens.caller(old).role == "operator"


def test_a_token_that_changes_while_it_is_first_read_is_followed(tmp_path, monkeypatch):
    monkeypatch.setattr(auth, "LOOK_PERIOD", 0.0)
    folder = token_folder(tmp_path / "t", operator=OPERATOR)
    read = Tokens._read

    def read_and_change(tokens):
        monkeypatch.setattr(Tokens, "_read", read)
        found = read(tokens)
        (folder / "operator").write_text("another-token-altogether")
        return found

    monkeypatch.setattr(Tokens, "_read", read_and_change)
    tokens = Tokens(folder)
    assert tokens.caller(f"Bearer {OPERATOR}".encode()) is None
    assert tokens.caller(b"Bearer another-token-altogether").role == "operator"


def test_a_token_that_is_taken_away_reads_no_open_stream(monkeypatch):
    monkeypatch.setattr(auth, "LOOK_PERIOD", 0.0)
    monkeypatch.setattr(api, "LOOK_PERIOD", 0.01)
    with running() as one:
        stream, said = connect(one), b""
        stream.sendall(head("GET", "/v1/events", token=READER))
        while b": cloudrc" not in said:
            said += stream.recv(4096)
        one.token_file.with_name("reader").unlink()
        assert one.post("/v1/missions", {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]})[0] == 201
        said = stream.recv(4096)
        assert said == b"0\r\n\r\n"  # the end, and no event
        one.until(lambda: one.gate._in_flight["reader", "stream"] == 0)
        stream.close()
        assert one.gate.counts["failed"] == 0
        assert one.complaints == []


@pytest.mark.parametrize(("revoked", "status"), [(False, b" 409 "), (True, b" 401 ")])
def test_a_token_revoked_during_the_body_commands_nothing(monkeypatch, revoked, status):
    """It may take 5 s to arrive."""
    monkeypatch.setattr(auth, "LOOK_PERIOD", 0.0)
    body = json.dumps({"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}).encode()
    with running() as one:
        one.flight.teleop.create(Order(SERVICE_PLAN), 0)  # or it would be made
        one.until(lambda: not one.gate._in_flight["operator", "request"])
        slow = connect(one)
        slow.sendall(head("POST", "/v1/missions", f"Content-Length: {len(body)}") + body[:9])
        one.until(lambda: one.gate._in_flight["operator", "request"] == 1)
        if revoked:
            one.token_file.write_text("another-token-altogether")
        slow.sendall(body[9:])
        answer = slow.recv(4096)
        assert status in answer
        assert (b"www-authenticate: Bearer" in answer) == revoked
        slow.close()
        (line,) = one.audited()
        assert (line["role"], line["status"]) == ("operator", int(status))
        assert one.gate.counts["failed"] == 0
