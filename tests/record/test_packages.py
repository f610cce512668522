"""Missing packages are named, and only recording needs them."""

from __future__ import annotations

import subprocess
import sys

import pytest

BLOCK = "import sys; sys.modules.update(dict.fromkeys({names!r}))\n"
NEEDED = ["lz4", "mcap", "rosbags", "zstandard"]


def run(code: str, without: list[str]) -> str:
    done = subprocess.run(
        [sys.executable, "-c", BLOCK.format(names=without) + code], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("module", ["reader", "recover", "merge"])
def test_a_missing_package_is_named_with_its_remedy(module: str) -> None:
    code = f"""
from cloudrc.errors import MissingPrerequisiteError
for name in {NEEDED}:
    for loaded in [m for m in sys.modules if m.startswith(("cloudrc.record", *{NEEDED}))]:
        del sys.modules[loaded]
    sys.modules[name] = None
    try: import cloudrc.record.{module}
    except MissingPrerequisiteError as error: print(error.exit_code, error)
"""
    for name, text in zip(NEEDED, run(code, []).splitlines(), strict=True):
        assert text.startswith(f"3 recording needs the package {name}, which is not installed")
        assert text.endswith("install it with: pip install 'cloudrc[record]'")


def test_flying_needs_none_of_them() -> None:
    code = (
        "from cloudrc.record import columns, hash, recorder, topics\n"
        "import cloudrc.drivers.recording\n"
        "print(len(columns.Recording.from_records([])['/pid']))"
    )
    assert run(code, NEEDED) == "0"


def test_hash_and_recorder_do_not_even_need_numpy() -> None:
    code = "from cloudrc.record import hash, recorder, topics; print('numpy' in sys.modules)"
    assert run(code, []) == "False"
