"""The images that were loaded are small, and hold what their role needs and no more."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from cloudrc import __version__
from tests.e2e.conftest import command

SIZES = {"world": 420, "cloud": 320}
"""At most, uncompressed [MB]."""
LOOK = """\
import json, os, shutil
from importlib.util import find_spec
found = [*filter(shutil.which, ["cc", "gcc", "g++", "make"])]
found += filter(find_spec, ["mujoco", "matplotlib", "pip"])
found += filter(os.path.exists, ["/root/.cache"])
print(json.dumps(found))
"""
"""What a compiler, a big package or pip has left; the base's own pip is not of our Python."""


@pytest.mark.parametrize(("role", "holds"), [("world", ["mujoco"]), ("cloud", [])])
def test_an_image_is_small_and_holds_no_more_than_its_role_needs(
    cluster: None, note: Callable[[str], None], role: str, holds: list[str]
) -> None:
    image = f"cloudrc/{role}:{__version__}"
    size = int(command("docker", "image", "inspect", "--format={{.Size}}", image)) / 1e6
    note(f"image {role}: asked {SIZES[role]} MB | {size:.0f} MB")
    assert size <= SIZES[role]
    look = ["docker", "run", "--rm", "--user=0", "--entrypoint=python", image, "-c", LOOK]
    assert json.loads(command(*look)) == holds
