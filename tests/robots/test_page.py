# SPDX-License-Identifier: Apache-2.0

"""The commands of docs/robot.md work, one after the other."""

import re
import shlex
from pathlib import Path

import pytest

from cloudrc.doors.cli.main import main

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "robot.md").read_text()
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.full
def test_the_page_leads_from_a_folder_to_two_compared_predictors(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for language, body in BLOCKS:
        if language == "yaml":
            with (tmp_path / "my_robot" / "robot.yaml").open("a") as file:
                file.write(body)
        else:
            assert main(shlex.split(body)[1:]) == 0, body
    assert "B has a lower" in capsys.readouterr().out
