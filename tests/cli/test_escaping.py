"""Text from files and from the API is escaped: it cannot control the terminal or fake a line."""

import json

import pytest
import yaml

from cloudrc.cli.main import main
from cloudrc.errors import BadInputError
from cloudrc.teleop.client import Api
from cloudrc.teleop.store import Order
from tests.cli.conftest import EVIL, assert_harmless
from tests.teleop.conftest import PLAN, running


@pytest.fixture
def printed(capsys):
    """Return a function that checks the output for the escaped text, and returns the output."""

    def check(count=None):
        said = "".join(capsys.readouterr())
        assert_harmless(said, count)
        return said

    return check


@pytest.mark.parametrize("words", ["run", "report", "recover", "link show"])
def test_a_name_in_an_error(words, printed):
    assert main([*words.split(), EVIL]) != 0
    (line,) = printed().splitlines()
    assert line.startswith("cloudrc: error: ")


@pytest.fixture
def api():
    """An API with a stored mission whose name is EVIL, as an older teleop may have taken it."""
    with running(unix=True) as one:
        made = one.bridge.submit(lambda service, now_ns: service.create(Order(PLAN, EVIL), now_ns))
        made.result(10.0)
        yield one


def test_a_missions_name(api, printed, call):
    for words in ("list", "status", "status m1", "hold", "cancel"):
        main(["mission", *words.split(), "--api", api.url])
        printed()
    for form, read in (("json", json.loads), ("yaml", yaml.safe_load)):
        said = call(f"mission list --api {api.url} -o {form}").out
        assert [c for c in said if (c != "\n" and ord(c) < 32) or 127 <= ord(c) < 160] == []
        assert read(said)["missions"][0]["name"] == EVIL
    with pytest.raises(BadInputError) as refused:
        Api(api.url).post("/v1/missions", {EVIL: 2, "waypoints": [{"position_m": [99, 0, 1]}]})
    assert_harmless(str(refused.value))
