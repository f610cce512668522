"""The net below the step "Light": what must not change, kept before and compared after.

    python -m tools.net --write before.json     # on the commit before
    python -m tools.net --compare before.json   # on the changed tree; exit 1 if anything differs

It has three parts: `flights`, `numbers` and `texts`; `--part` chooses one. `gone.txt` lists what
goes on purpose: the comparison leaves it out. With `--path`, only the true path, the commands and
the verdict of flights are compared, for a change that adds or renames columns on purpose.
"""
