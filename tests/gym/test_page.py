"""The examples of docs/gym.md run."""

import re
import runpy
from pathlib import Path

PAGE = (Path(__file__).parents[2] / "docs" / "gym.md").read_text()


def test_the_examples_of_the_page_run(tmp_path, capsys):
    program = tmp_path / "page.py"
    program.write_text("\n".join(re.findall("```python\n(.*?)```", PAGE, re.DOTALL)))
    runpy.run_path(str(program))
    assert "delay_measured" in capsys.readouterr().out
