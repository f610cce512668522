"""The folder of a run, and the link to the newest one."""

import pytest

from cloudrc.errors import BadInputError
from cloudrc.runs.folder import new_folder


def test_a_copy_of_the_link_to_the_newest_run_stays_and_is_told(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    first = new_folder(None, "hover")
    assert (tmp_path / "runs/latest").resolve() == first.resolve()
    assert not caplog.messages
    (tmp_path / "runs/latest").unlink()
    (tmp_path / "runs/latest").mkdir()
    second = new_folder(None, "hover")
    assert second != first
    assert "runs/latest is no link and stays as it is" in caplog.text


def test_a_process_may_use_its_folder_again_until_something_is_in_it(tmp_path):
    """A notebook repeats a call that has failed."""
    out = tmp_path / "out"
    assert new_folder(out, "") == new_folder(out, "") == out
    (out / "config.yaml").touch()
    with pytest.raises(BadInputError, match="already exists"):
        new_folder(out, "")
    assert (out / "config.yaml").exists()
