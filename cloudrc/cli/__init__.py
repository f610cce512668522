"""The command line: one module per command.

A command's module has `arguments(parser)` and `execute(options) -> exit code`. It imports numpy,
mujoco, matplotlib, pydantic and yaml only inside functions, so that `cloudrc --help` stays fast.
"""
