# SPDX-License-Identifier: Apache-2.0

"""Completion: a script for each shell that knows commands, options and shipped names."""

import shutil
import subprocess

import pytest


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_knows_commands_and_options(shell, call):
    script = call(f"completion {shell}").out
    for word in ("doctor", "seeds", "paper-verbatim", "satellite", "link.profile=lte"):
        assert word in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, text=True, check=True)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["link", "show", "satel"], ["satellite"]),
        (["run", "--set", "world.tun"], ["world.tuning="]),
        (["link", "set", "uplink.dela"], ["uplink.delay_ms="]),
    ],
)
def test_bash_completes_names(words, found, call):
    script = call("completion bash").out
    line = " ".join(["cloudrc", *words])
    probe = (
        f"\nCOMP_WORDS=({line}); COMP_CWORD={len(words)}; COMP_LINE='{line}'"
        f"; COMP_POINT={len(line)}\n_shtab_cloudrc cloudrc {words[-1]} x"
        '\nprintf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(["bash"], input=script + probe, text=True, capture_output=True)
    assert done.stdout.split() == found, done.stderr
