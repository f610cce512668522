"""The folder of a run, and the link to the newest one."""

import os
import subprocess
import sys

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


CLAIM = """
import sys
from pathlib import Path
from cloudrc.runs.folder import new_folder
new_folder(Path(sys.argv[1]), "", is_shared=sys.argv[2:] == ["shared"])
print("has it", flush=True)
input()
"""


@pytest.mark.parametrize("shared", [[], ["shared"]])
def test_only_one_of_two_commands_gets_a_folder_which_shards_share(shared, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-c", CLAIM, str(out), *shared]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as first:
        assert first.stdout.readline() == "has it\n"
        with pytest.raises(BadInputError, match="already exists; name a new folder"):
            new_folder(out, "")
        if shared:
            assert new_folder(out, "", is_shared=True) == out
        first.communicate("\n")
    if not shared:
        assert new_folder(out, "") == out, "the first command has left nothing"


def test_a_process_may_use_its_folder_again_until_something_is_in_it(tmp_path):
    """A notebook repeats a call that has failed, and flies into many folders."""
    before = len(os.listdir("/proc/self/fd"))
    for number in range(5):
        out = tmp_path / str(number)
        assert new_folder(out, "") == new_folder(out, "") == out
        (out / "config.yaml").touch()
        with pytest.raises(BadInputError, match="already exists"):
            new_folder(out, "")
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_folder_has_no_colon_in_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert new_folder(None, "eval-my_env:My-v0").name == "eval-my_env-My-v0-1"
