"""Text from files and from the API is escaped: it cannot control the terminal or fake a line."""

import pytest

from cloudrc.cli.main import main
from tests.cli.conftest import EVIL, assert_harmless


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
