# SPDX-License-Identifier: Apache-2.0

"""Dockerfiles and locks: pinned bases and versions."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from cloudrc import __version__

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ROLES = {"world": ("world", "record", "mpc"), "cloud": ("record", "api", "mpc")}
BUILD = ROOT / "images" / "build-requirements.txt"
DRAWS = ROOT / "images" / "world-camera" / "requirements.txt"
LOCKS = {
    ROOT / "images" / "world" / "requirements.txt": ROLES["world"],
    ROOT / "images" / "cloud" / "requirements.txt": ROLES["cloud"],
    ROOT / "images" / "cloud-ros" / "requirements.txt": ("world", "record", "api", "policy", "mpc"),
    ROOT / "tests" / "requirements.txt": ("dev", "deep"),
}


def locked(path):
    """Read a lock: package -> version."""
    return dict(re.findall(r"^([a-z0-9-]+)(?:\[.*\])?==(\S+)", path.read_text(), re.MULTILINE))


def wanted(extras):
    """Read the requirements of pyproject.toml, with cloudrc's own extras expanded."""
    found = [Requirement(line) for line in PROJECT["dependencies"]]
    for extra in extras:
        for line in PROJECT["optional-dependencies"][extra]:
            asked = Requirement(line)
            found += wanted(tuple(asked.extras)) if asked.name == "cloudrc" else [asked]
    return found


@pytest.mark.parametrize("lock", LOCKS, ids=lambda path: path.parent.name)
def test_a_lock_satisfies_pyproject(lock):
    versions = locked(lock)
    for requirement in wanted(LOCKS[lock]):
        name = requirement.name.lower().replace("_", "-")
        assert name in versions, f"{name} is not in {lock}; run: make lock"
        assert requirement.specifier.contains(versions[name], prereleases=True), name


@pytest.mark.parametrize("lock", [*LOCKS, BUILD, DRAWS])
def test_every_package_has_a_hash_and_no_address(lock):
    text = lock.read_text()
    blocks = re.split(r"^(?=[a-z0-9-]+(?:\[.*\])?==)", text, flags=re.MULTILINE)[1:]
    assert all("--hash=sha256:" in block for block in blocks)
    assert blocks
    assert "://" not in text


@pytest.mark.parametrize("role", ["cloud", "cloud-ros", "prometheus", "world"])
def test_a_base_image_is_a_stage_or_has_a_digest(role):
    text = (ROOT / "images" / role / "Dockerfile").read_text()
    stages = re.findall(r"^FROM \S+ AS (\S+)$", text, re.MULTILINE)
    bases = re.findall(r"^FROM (\S+)", text.replace("${ROLE}", role), re.MULTILINE)
    pinned = [base for base in bases if re.fullmatch(r"\S+@sha256:[0-9a-f]{64}", base)]
    assert pinned
    assert {*bases} - {*pinned} <= {"${BASE}", *stages}


LOG = """#!/bin/sh
case "$*" in *clusters*) echo cloudrc ;; *) echo $* >> log ;; esac
"""
"""A docker or kind that writes down what it is asked."""


def test_a_rebuilt_image_has_a_tag_of_its_own_and_is_loaded_under_both(tmp_path, monkeypatch):
    for name in ("Makefile", "cloudrc/version.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    for name in ("docker", "kind"):
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).write_text(LOG)
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=":")

    def run(*words):
        done = subprocess.run(words, cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout

    def load(*targets):
        (tmp_path / "log").write_text("")
        said, log = run("make", *(targets or ("images", "kind-load"))), tmp_path / "log"
        (tag,) = re.findall(r"image\.tag=(\S+)", said)
        for role in ("world", "world-camera", "cloud"):
            for each in (tag, __version__):
                assert log.read_text().count(f"cloudrc/{role}:{each}")
        assert (tmp_path / "build" / "loaded" / "kind-cloudrc").read_text().strip() == tag
        return tag

    run("git", "init", "-q")
    run("git", "add", "Makefile", "cloudrc")
    run("git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first")
    clean = load()
    assert re.fullmatch(rf"{__version__}-g[0-9a-f]{{7,}}", clean)
    (tmp_path / "cloudrc" / "new.py").write_text("1")
    dirty = load()
    assert dirty.startswith(f"{clean}-dirty-")
    (tmp_path / "cloudrc" / "new.py").write_text("2")
    assert load("kind-load") == dirty, "what was built"
    assert load() not in (clean, dirty)
    (tmp_path / "cloudrc" / "new.py").unlink()
    (tmp_path / "notes.txt").write_text("no part of an image")
    assert load() == clean
