"""Completion: a script for each shell, and an error if shtab is missing."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess

import pytest

from cloudrc.cli.main import main


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_knows_commands_and_options(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "doctor" in script
    assert "seeds" in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, text=True, check=True)


def test_bash_completes_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    main(["completion", "bash"])
    script = capsys.readouterr().out
    probe = (
        "\nCOMP_WORDS=(cloudrc do); COMP_CWORD=1; COMP_LINE='cloudrc do'; COMP_POINT=10"
        '\n_shtab_cloudrc cloudrc do cloudrc; echo "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(["bash"], input=script + probe, text=True, capture_output=True)
    assert done.stdout.strip() == "doctor"


def test_an_error_names_the_missing_shtab(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["completion", "bash"]) == 3
    assert "pip install shtab" in capsys.readouterr().err
