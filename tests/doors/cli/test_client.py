# SPDX-License-Identifier: Apache-2.0

"""The API behind a proxy, or another program at its address: it works, or one line says why not."""

import pytest

from cloudrc.teleop.client import Api, ApiError, UnreachableError
from tests.support.http import serve

STATE = "/v1/state"


PAGE = "<!DOCTYPE html><title>Please log in</title>"


@pytest.fixture
def proxy():
    """Serve `answers`: path -> status, content, maybe headers; else 404."""
    answers = {}
    server = serve(lambda request, body: answers.get(request.path, (404, {"detail": "Not Found"})))
    yield answers, server.url
    server.shutdown()
    server.server_close()


def test_an_api_behind_the_path_of_a_proxy_is_reached(proxy):
    answers, url = proxy
    answers["/robots/7" + STATE] = 200, {"mission": None}
    assert Api(f"{url}/robots/7/").get(STATE) == {"mission": None}


@pytest.mark.parametrize(
    ("answer", "said", "kind"),
    [
        ((404, {"detail": "Not Found"}), "404 Not Found: a proxy or another", ApiError),
        ((200, PAGE, {"Content-Type": "text/html; charset=utf-8"}), "200 OK: a proxy or", ApiError),
        ((302, "", {"Location": "https://sso/x"}), "302 Found: a proxy or", ApiError),
        ((502, PAGE), "the API answered 502 Bad Gateway", UnreachableError),
    ],
)
def test_an_answer_of_another_program_is_told_in_one_line(proxy, answer, said, kind):
    """Only for a server that is away it is worth to wait."""
    answers, url = proxy
    answers[STATE] = answer
    with pytest.raises(kind, match=rf"^[^\n]*{said}[^\n]*$") as told:
        Api(url).get(STATE)
    assert type(told.value) is kind
