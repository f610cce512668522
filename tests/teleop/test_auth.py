# SPDX-License-Identifier: Apache-2.0

"""Who may do what, the gate before the API, and the log of who commanded what."""

import json
import os
import re

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.teleop.auth import Tokens
from tests.teleop.conftest import A_MISSION, OPERATOR, READER, connect, running

ANOTHER = "another-token-altogether"
WRONG = [None, "", OPERATOR[:-1], OPERATOR + "x", "é"]


def token_folder(folder, **tokens):
    folder.mkdir(exist_ok=True)
    for role, text in tokens.items():
        if text is None:
            os.mkfifo(folder / role)
            continue
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
        ({"operator": "short"}, "operator: a token is 16 to 512 visible"),
        ({"operator": "o" * 16, "reader": "o" * 16 + "\n"}, "both roles have the same token"),
        ({"operator": None}, "operator: not a file; make one"),  # and is not awaited
    ],
)
def test_unusable_tokens_are_refused_and_not_shown(tmp_path, tokens, said):
    with pytest.raises(BadInputError, match=said) as refused:
        Tokens(token_folder(tmp_path / "t", **tokens))
    assert not [text for text in tokens.values() if text and text in str(refused.value)]


def test_a_changed_token_file_counts_at_once():
    with running() as api:

        def roles(*tokens):
            return [api.send(api.request("/v1/state", token=token))[0] for token in tokens]

        assert roles(OPERATOR, ANOTHER, READER) == [200, 401, 200]
        api.token_file.write_text(ANOTHER)
        assert roles(OPERATOR, ANOTHER, READER) == [401, 200, 200]
        api.token_file.write_text("short")  # an unusable file admits nobody
        assert roles(OPERATOR, ANOTHER, READER) == [401, 401, 401]
        api.token_file.write_text(OPERATOR)
        api.token_file.with_name("reader").unlink()
        assert roles(OPERATOR, READER) == [200, 401]


# The gate


def routes(api):
    """Every route that there is, and some that there are not."""
    for path, verbs in api.get("/openapi.json")["paths"].items():
        yield from ((verb.upper(), path.replace("{id}", "m1")) for verb in verbs)
    for path in ("/", "/openapi.json", "/docs", "/v1", "/v1/estop/", "/v1/missions/../state"):
        yield from ((verb, path) for verb in ("GET", "POST", "PUT", "DELETE", "OPTIONS", "TRACE"))


def effects(api):
    return api.flight.kept.copy(), len(api.flight.requests), len(api.alarms)


STREAMS = ("/v1/events", "/v1/robot")
"""Routes whose answers do not end."""


def ask_all(api, token, header=None):
    """Ask every route with a token, or with an own header; return method and status of each."""
    before, answers = effects(api), []
    for method, path in routes(api):
        if path in STREAMS and token == READER:
            continue
        data = None if method == "GET" else json.dumps(A_MISSION).encode()
        headers = {} if header is None else {"Authorization": header}
        status, answer = api.send(api.request(path, data, token, method, headers))
        answers.append((method, status))
        assert status != 401 or list(answer) == ["detail"]
    assert effects(api) == before
    return answers


@pytest.mark.promise("api-needs-a-token")
@pytest.mark.parametrize("token", WRONG)
def test_without_a_valid_token_every_route_answers_401(idle, token):
    header = None if token is None else f"Bearer {token}".encode("latin1")
    assert {status for _, status in ask_all(idle, None, header)} == {401}


@pytest.mark.promise("api-needs-a-token")
def test_only_the_bearer_scheme_is_known_and_it_is_announced(idle):
    for scheme, known in (("", 401), ("Basic ", 401), ("Bearer x ", 401), ("bEARER ", 200)):
        headers = {"Authorization": f"{scheme}{OPERATOR}"}
        assert idle.send(idle.request("/v1/state", headers=headers, token=None))[0] == known
    with connect(idle) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        assert b"www-authenticate: Bearer" in connection.recv(4096)


@pytest.mark.promise("api-needs-a-token")
def test_a_reader_may_look_and_nothing_else(idle):
    for method, status in ask_all(idle, READER):
        assert status in ((200, 404, 405) if method == "GET" else (403,)), method


# The log of commands


def test_each_command_is_logged_with_caller_and_answer():
    with running() as api:
        api.post("/v1/missions", {**A_MISSION, "key": "uid"})
        named = {"X-Forwarded-For": "203.0.113.7", "X-Forwarded-Proto": "https"}  # not believed
        body = json.dumps(A_MISSION).encode()
        api.send(api.request("/v1/missions", body, headers=named, method="POST"))
        api.post("/v1/hold", token=READER)
        api.get("/v1/state")
        api.post("/v1/estop/")
        created, refused, stopped = api.logged()
    assert re.fullmatch(
        r"operator-[0-9a-f]{8} 127\.0\.0\.1:\d+ POST /v1/missions: 201 m1 \w+", created
    )
    assert "POST /v1/missions: 409 m1 " in refused
    assert "cancel it first" in refused
    assert "POST /v1/estop: 200 m1 stopping" in stopped
    assert OPERATOR not in created + refused + stopped
