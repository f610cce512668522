# SPDX-License-Identifier: Apache-2.0

"""The numbers that pages show are those that their commands give."""

import pytest

from tests.conftest import nightly
from tools.shown import NIGHTLY_MAX_S, SHOWN, agrees

QUICK = [each for each in SHOWN if each.duration < NIGHTLY_MAX_S]


@pytest.mark.parametrize("shown", SHOWN, ids=lambda shown: shown.page)
def test_a_page_has_the_numbers_that_are_compared(shown):
    assert shown.missing_on_page() == []


@pytest.mark.process
@pytest.mark.parametrize("shown", nightly(*QUICK), ids=lambda shown: shown.page)
def test_a_command_gives_the_numbers_of_its_page(shown, tmp_path):
    assert [*shown.differences(tmp_path)] == []


@pytest.mark.parametrize(
    ("value", "shown", "same"),
    [(0.09849, "98.5 ms", True), (0.09856, "98.5 ms", False), (0.1418, ".142 s", True)],
)
def test_a_number_agrees_if_it_is_rounded_to_what_the_page_has(value, shown, same):
    assert agrees(value, shown) is same
