"""The command line: one module per command.

Each module has `arguments(parser)` and `execute(options) -> exit code`. Modules import numpy,
mujoco, matplotlib, pydantic and yaml inside functions only, so that `cloudrc --help` stays fast.
"""
