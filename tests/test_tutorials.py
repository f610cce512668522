"""The commands of the tutorials work, and print what the pages show."""

import pytest

from tests.conftest import nightly
from tests.tutorials import FOLDER, Reader


@pytest.mark.process
@pytest.mark.parametrize("name", ["policy", *nightly("fly-and-steer")])
def test_a_tutorial_works(name, tmp_path):
    reader = Reader(tmp_path)
    try:
        reader.play(name)
    finally:
        reader.leave()


def test_every_tutorial_is_played():
    """tests/link/exec and tests/e2e play the last two."""
    names = {path.stem for path in FOLDER.glob("*.md")}
    assert names == {"policy", "fly-and-steer", "two-programs", "cluster"}
