"""The examples of docs/gym.md run, and its table is that of the tool."""

import re
import runpy
from pathlib import Path

from tools import survival

PAGE = (Path(__file__).parents[2] / "docs" / "gym.md").read_text()


def test_the_examples_of_the_page_run(tmp_path, capsys):
    program = tmp_path / "page.py"
    program.write_text("\n".join(re.findall("```python\n(.*?)```", PAGE, re.DOTALL)))
    runpy.run_path(str(program))
    assert "delay_measured" in capsys.readouterr().out


def test_the_execution_of_chunks_decides_who_stands():
    shaky = survival.profile(*survival.LINKS["80 ± 20"])
    stood = {name: survival.stands(shaky, way, 1) for name, way in survival.WAYS.items()}
    assert stood == {name: not name.startswith(("newest", "broker")) for name in survival.WAYS}
    ideal = survival.profile(*survival.LINKS["0"])
    assert all(survival.stands(ideal, way, 1) for way in survival.WAYS.values())
    head = f"| round trip [ms] | {' | '.join(survival.WAYS)} |"
    assert head in PAGE
