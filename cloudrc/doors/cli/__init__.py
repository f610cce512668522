# SPDX-License-Identifier: Apache-2.0

"""The command line: one module per command.

Each module has `arguments(parser)` and `execute(options) -> exit code`. Modules import numpy,
mujoco, matplotlib, pydantic and yaml inside functions only, so that `cloudrc --help` stays fast.
"""

import sys

if sys.platform == "win32":  # before a module of Unix is imported
    print("cloudrc: error: Windows: install cloudrc in WSL2 ('wsl --install')", file=sys.stderr)
    raise SystemExit(3)
