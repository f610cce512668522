"""The hash of the sources that a search names: all that its flights depend on, and little else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from cloudrc.cli.faults_slices import NOT_FLOWN, sources


def test_the_sources_are_all_that_a_flight_depends_on(tmp_path: Path) -> None:
    apart = ("cli/main.py", "faults/real/wire.py", "link/verify_loss.py", "world/notes.txt")
    names = (*apart, "world/scene.xml", "world/guard.py", "faults/realm.py")
    for name in names:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    seen = [sources(tmp_path)]
    for name in names:
        (tmp_path / name).write_text("other")
        seen.append(sources(tmp_path))
    assert len({*seen[: len(apart) + 1]}) == 1
    assert len({*seen[len(apart) :]}) == 4
    (tmp_path / "world/guard.py").rename(tmp_path / "world/other.py")
    assert sources(tmp_path) not in seen


FLIGHTS = """
import importlib, pkgutil, sys
import cloudrc.faults
from cloudrc.faults import adversary, compose, fuzz

for module in pkgutil.iter_modules(cloudrc.faults.__path__, "cloudrc.faults."):
    if not module.ispkg:
        importlib.import_module(module.name)
for seed in (1, 2):
    for schedule in (compose.compose(seed), compose.calm(seed), adversary.choose(seed)):
        fuzz.fly(schedule)
print(*sys.modules)
"""


def test_a_flight_of_a_search_imports_nothing_that_its_hash_leaves_out() -> None:
    done = subprocess.run([sys.executable, "-c", FLIGHTS], capture_output=True, text=True)
    names = {f"{name.removeprefix('cloudrc.').replace('.', '/')}/" for name in done.stdout.split()}
    assert "world/guard/" in names, done.stderr
    assert [name for name in names if name.startswith(NOT_FLOWN)] == []
