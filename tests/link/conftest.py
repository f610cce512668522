"""The laboratory for real netem, made for each file of tests that asks for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import netem_laboratory as lab
import pytest

from cloudrc.errors import MissingPrerequisiteError
from cloudrc.link.netem import Netem
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.tc import write_tables


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The laboratory; the value is the folder of tc's distributions."""
    folder = tmp_path_factory.mktemp("tc")
    write_tables(folder)
    try:
        with lab.laboratory():
            yield folder
    except lab.UnableError as error:
        pytest.exit(f"netem cannot be tested here: {error}", MissingPrerequisiteError.exit_code)


@pytest.fixture
def shaped(tables: Path) -> Iterator[Netem]:
    """netem without conditions, in force."""
    netem = lab.netem(tables, DirectionProfile())
    assert netem.follow_peer(lab.PEER) == lab.PEER
    yield netem
    netem.close()
