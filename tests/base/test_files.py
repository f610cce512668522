# SPDX-License-Identifier: Apache-2.0

"""Whose a file is: nobody else may own or write it, its folder, or a folder above."""

import os
from types import SimpleNamespace

import pytest

from cloudrc.base import files
from cloudrc.base.files import make_own_folder, who_may_write, write_json

OTHER = os.geteuid() + 1
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")


@pytest.fixture
def file(tmp_path):
    """Make a file in a folder that only this user may write."""
    folder = tmp_path / "mine"
    folder.mkdir(mode=0o700)
    path = folder / "file"
    path.touch(0o600)
    return path


def test_an_own_file_in_an_own_folder_is_private(file):
    assert who_may_write(file) == who_may_write(file.parent) == ""


@pytest.mark.parametrize("at", [0, 1, 2], ids=["file", "folder", "above"])
@pytest.mark.parametrize(
    ("mode", "said"), [(0o757, "everybody may write to"), (0o775, "a group may write to")]
)
def test_a_place_that_others_may_write_is_named(file, at, mode, said, monkeypatch):
    monkeypatch.setattr(files, "_is_group_of_one", lambda gid: False)
    place = [file, *file.parents][at]
    place.chmod(mode)
    assert who_may_write(file) == f"{said} {place}"
    place.chmod(0o700)


@as_root
@pytest.mark.parametrize("at", [0, 1, 2], ids=["file", "folder", "above"])
def test_a_place_of_another_user_is_named(file, at):
    place = [file, *file.parents][at]
    os.chown(place, OTHER, -1)
    assert who_may_write(file) == f"another user owns {place}"


@as_root
def test_a_symbolic_link_counts_with_its_owner_its_place_and_its_target(file, tmp_path):
    link = tmp_path / "link"
    link.symlink_to("mine")
    assert who_may_write(link / "file") == ""
    file.parent.chmod(0o777)
    assert who_may_write(link / "file") == f"everybody may write to {file.parent}"
    file.parent.chmod(0o700)
    os.chown(link, OTHER, -1, follow_symlinks=False)
    assert who_may_write(link / "file") == f"another user owns {link}"
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    with pytest.raises(OSError, match="circle"):
        who_may_write(circle)


def test_a_group_that_has_only_this_user_may_write(file, monkeypatch):
    file.chmod(0o660)
    gid = file.stat().st_gid
    user = SimpleNamespace(pw_gid=gid, pw_name="me")
    monkeypatch.setattr("pwd.getpwuid", lambda uid: user)
    for members, name, found in (([], "me", ""), (["you"], "me", "a"), ([], "users", "a")):
        group = SimpleNamespace(gr_name=name, gr_mem=members)
        monkeypatch.setattr("grp.getgrgid", lambda gid, group=group: group)
        assert who_may_write(file)[:1] == found


@pytest.mark.parametrize("umask", [0, 0o22])
def test_new_folders_are_for_this_user_alone(tmp_path, umask):
    folder = tmp_path / "a" / "b"
    before = os.umask(umask)
    try:
        assert make_own_folder(folder) == ""
    finally:
        os.umask(before)
    assert [path.stat().st_mode & 0o777 for path in (folder, folder.parent)] == [0o700, 0o700]


def test_json_with_a_number_that_is_not_finite_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "report.json", {"rms": float("nan")})
    assert not [*tmp_path.iterdir()]
