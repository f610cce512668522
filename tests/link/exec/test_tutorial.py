# SPDX-License-Identifier: Apache-2.0

"""The tutorial of two programs works, in real namespaces."""

import pytest

from tests.tutorials import Reader


@pytest.mark.tun
@pytest.mark.full
def test_the_tutorial_of_two_programs_works(tmp_path):
    Reader(tmp_path, "namespaces").play("docs/tutorials/two-programs.md")
