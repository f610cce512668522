"""Dockerfiles and locks: pinned versions, and small images."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ROLES = {"world": ("world", "record", "mpc"), "cloud": ("record", "api", "mpc")}
LOCKS = {
    ROOT / "images" / "world" / "requirements.txt": ROLES["world"],
    ROOT / "images" / "cloud" / "requirements.txt": ROLES["cloud"],
    ROOT / "images" / "cloud-ros" / "requirements.txt": ("world", "record", "api", "policy", "mpc"),
    ROOT / "tests" / "requirements.txt": ("dev",),
}
BUILD = ROOT / "images" / "build-requirements.txt"


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


@pytest.mark.parametrize("lock", [*LOCKS, BUILD])
def test_every_package_has_a_hash_and_no_address(lock):
    text = lock.read_text()
    blocks = re.split(r"^(?=[a-z0-9-]+(?:\[.*\])?==)", text, flags=re.MULTILINE)[1:]
    assert all("--hash=sha256:" in block for block in blocks)
    assert blocks
    assert "://" not in text
