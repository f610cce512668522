"""Run folders: numbered, never overwritten; `latest` points to the newest."""

from __future__ import annotations

from pathlib import Path

import pytest

from cloudrc.cli.find_run import new_folder
from cloudrc.errors import BadInputError


def test_folders_are_numbered_and_latest_is_the_newest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = [new_folder(None, "paper-local-seed1").as_posix() for _ in range(3)]
    assert names == [f"runs/paper-local-seed1-{n}" for n in (1, 2, 3)]
    assert Path("runs/latest").resolve() == Path(names[-1]).resolve()


def test_an_empty_or_new_folder_is_accepted(tmp_path: Path) -> None:
    assert new_folder(tmp_path, "x") == tmp_path
    assert new_folder(tmp_path / "a" / "b", "x").is_dir()


def test_an_error_says_which_folder_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs").write_text("a file")
    with pytest.raises(BadInputError, match=r"^runs/ in the working folder: .*with --out$"):
        new_folder(None, "x")
    with pytest.raises(BadInputError, match=r"^--out runs/x: .*name another folder$"):
        new_folder(Path("runs/x"), "x")


@pytest.mark.parametrize("name", ["full", "file"])
def test_existing_files_are_not_overwritten(name: str, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "report.json").write_text("{}")
    (tmp_path / "file").write_text("x")
    with pytest.raises(BadInputError, match=r"never overwritten"):
        new_folder(tmp_path / name, "x")
