"""The examples of docs/gym.md run."""

import runpy

from tests.support.pages import blocks


def test_the_examples_of_the_page_run(tmp_path, capsys):
    program = tmp_path / "page.py"
    program.write_text("\n".join(blocks("gym", "python")))
    runpy.run_path(str(program))
    assert "delay_measured" in capsys.readouterr().out
