# SPDX-License-Identifier: Apache-2.0

"""The examples of docs/gym.md, docs/train.md and docs/channel.md run."""

import pytest

from tests.support.pages import run_page


@pytest.mark.parametrize(
    ("page", "printed"),
    [("gym", "delay_measured"), ("train", "actions"), ("channel", "largest_error")],
)
def test_the_examples_of_a_page_run(tmp_path, capsys, page, printed):
    run_page(page, tmp_path)
    assert printed in capsys.readouterr().out
