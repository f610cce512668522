"""The examples of docs/gym.md run."""

from tests.support.pages import run_page


def test_the_examples_of_the_page_run(tmp_path, capsys):
    run_page("gym", tmp_path)
    assert "delay_measured" in capsys.readouterr().out
