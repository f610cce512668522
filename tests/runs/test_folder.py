"""The folder of a run, and the link to the newest one."""

import pytest

from cloudrc.errors import BadInputError
from cloudrc.runs.folder import new_folder


def test_a_process_may_use_its_folder_again_until_something_is_in_it(tmp_path):
    """A notebook repeats a call that has failed."""
    out = tmp_path / "out"
    assert new_folder(out, "") == new_folder(out, "") == out
    (out / "config.yaml").touch()
    with pytest.raises(BadInputError, match="already exists"):
        new_folder(out, "")
    assert (out / "config.yaml").exists()
