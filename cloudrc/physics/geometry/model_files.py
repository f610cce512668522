# SPDX-License-Identifier: Apache-2.0

"""Find the files that a robot or a scene consists of, without MuJoCo.

`mujoco.mju_getXMLDependencies` misses a height field in `meshdir`, and all files under `strippath`.
"""

from __future__ import annotations

import os
from contextlib import suppress
from itertools import product
from pathlib import Path
from xml.etree import ElementTree

FOLDERS = ("assetdir", "meshdir", "texturedir")
"""Attributes of the element `compiler` that name the folder of other files."""


def model_files(path: Path) -> list[Path]:
    """Return an MJCF file and each file that it names, also by an included file.

    MuJoCo looks for a file in one folder, which depends on its version, the element and the
    including file. Return what exists in any of these folders: a file too many does no harm.
    """
    found, folders, names = {path}, {path.parent}, set[str]()
    unread = {path}
    while unread:
        for file in unread:
            named, below = _named(file)
            names |= named
            folders |= {file.parent} | {file.parent / name for name in below}
            folders |= {path.parent / name for name in below}
        places = {Path(os.path.normpath(folder / name)) for folder, name in product(folders, names)}
        unread = {place for place in places - found if os.path.isfile(place)}
        found |= unread
    return sorted(found)


def _named(file: Path) -> tuple[set[str], set[str]]:
    """Return the names of files and of folders in an XML file; none if it is no XML file."""
    names, folders = set[str](), set[str]()
    with suppress(OSError, ElementTree.ParseError, ValueError, LookupError):
        for element in ElementTree.parse(file).iter():
            for attribute, value in element.items():
                if attribute.startswith("file"):
                    names |= {value, Path(value).name}
                elif attribute in FOLDERS:
                    folders.add(value)
    return names, folders
