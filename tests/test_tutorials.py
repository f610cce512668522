# SPDX-License-Identifier: Apache-2.0

"""The commands of the tutorials work, and print what the pages show."""

import pytest

from tests.conftest import nightly
from tests.support.pages import DOCS
from tests.tutorials import Reader


@pytest.mark.process
@pytest.mark.parametrize("name", ["policy", *nightly("fly-and-steer", "see")])
def test_a_tutorial_works(name, tmp_path):
    reader = Reader(tmp_path, "a session")
    try:
        reader.play(f"docs/tutorials/{name}.md")
    finally:
        reader.leave()


def test_every_tutorial_is_played():
    """tests/link/exec and tests/e2e play the last two."""
    names = {path.stem for path in DOCS.glob("tutorials/*.md")}
    assert names == {"policy", "see", "fly-and-steer", "two-programs", "cluster"}
