# SPDX-License-Identifier: Apache-2.0

"""Put the machine code of steps and predictions into a wheel, if CLOUDRC_NATIVE is 1.

Otherwise the wheel is pure Python, and a machine with a compiler makes the code when it flies.
"""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).parent
PLATFORMS = {"linux": "manylinux_2_17", "darwin": "macosx_11_0"}
"""Oldest systems on which the code runs: it needs nothing of the C library."""


class NativeStep(BuildHookInterface):  # type: ignore[type-arg]
    """Compile before the wheel is packed, and clean up afterwards."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and mark the wheel as one for this platform."""
        if os.environ.get("CLOUDRC_NATIVE") != "1" or version == "editable":
            return
        sys.path.insert(0, str(ROOT))
        from cloudrc.robots.native.library import ADVICE, built_file, compile_to, compilers

        command = next((command for _, command in compilers()), None)
        if command is None:
            raise RuntimeError(f"CLOUDRC_NATIVE=1: {ADVICE}")
        self._file = built_file()
        compile_to(self._file, command)
        build_data["artifacts"].append(self._file.relative_to(ROOT).as_posix())
        system = PLATFORMS[sys.platform]
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{system}_{platform.machine()}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the compiled file, so that the source tree stays as it was."""
        if hasattr(self, "_file"):
            self._file.unlink()
