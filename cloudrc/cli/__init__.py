"""The command line: arguments come in, text and an exit code go out; one file per command.

A command's file has `arguments(parser)` and `execute(options) -> exit code`. It imports at its
top only what is quick; numpy, mujoco, matplotlib, pydantic and yaml are imported where they are
used, so that `cloudrc --help` answers at once.
"""
