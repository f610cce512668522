"""The random draws are pure, in range, and independent of what was asked before."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.link import draws
from cloudrc.link.draws import BLOCK, CHAIN_BLOCKS, Purpose, bad_states, normals, uniforms

KEY = draws.stream_key(1, True, 1, 3)
FIRST = [0.91781617987454, 0.51679997741454, 0.6141663944716]


def test_the_first_draws_of_a_stream_are_these() -> None:
    """A change of the draws changes every published flight; note it in the change log."""
    assert uniforms(KEY, Purpose.DELAY, 0)[:3] == pytest.approx(FIRST, abs=1e-12)


def test_streams_purposes_and_blocks_do_not_overlap() -> None:
    keys = [KEY, *(draws.stream_key(*one) for one in (
        (2, True, 1, 3), (1, False, 1, 3), (1, True, 2, 3), (1, True, 1, 4)
    ))]  # fmt: skip
    drawn = [uniforms(key, p, b) for key in keys for p in Purpose for b in range(10)]
    values = np.concatenate(drawn)
    assert np.unique(values).size == values.size


def test_nobody_can_write_into_the_cache() -> None:
    with pytest.raises(ValueError, match="read-only"):
        uniforms(KEY, Purpose.DELAY, 0)[0] = 0.5


@given(block=st.integers(0, 2**56 - 1), purpose=st.sampled_from(Purpose))
@settings(max_examples=50, deadline=None)
def test_uniforms_stay_inside_the_open_interval(block: int, purpose: Purpose) -> None:
    values = uniforms(KEY, purpose, block)
    assert values.shape == (BLOCK,)
    assert 0.0 < values.min() < 0.1
    assert 0.9 < values.max() < 1.0


@given(blocks=st.lists(st.integers(0, 3 * CHAIN_BLOCKS), min_size=1, max_size=4))
@settings(max_examples=20, deadline=None)
def test_chains_do_not_depend_on_what_was_asked_before(blocks: list[int]) -> None:
    found = []
    for order in (blocks, blocks[::-1]):
        for function in (uniforms, normals, bad_states):
            function.cache_clear()
        found.append([(normals(KEY, 0, b, 0.9), bad_states(KEY, b, 0.02, 0.2)) for b in order])
    assert found[0] == found[1][::-1]


def test_the_recursion_is_the_one_in_the_docstring() -> None:
    fresh = normals(KEY, Purpose.DELAY, 0, 0.0)
    correlated = normals(KEY, Purpose.DELAY, 0, 0.6)
    assert correlated[0] == fresh[0]
    assert correlated[1] == pytest.approx(0.6 * fresh[0] + 0.8 * fresh[1])
    assert normals(KEY, Purpose.DELAY, 1, 0.6)[0] == pytest.approx(
        0.6 * correlated[-1] + 0.8 * normals(KEY, Purpose.DELAY, 1, 0.0)[0]
    )


def test_the_chain_turns_where_the_draws_say() -> None:
    state = bad_states(KEY, 0, 0.3, 0.4)
    draw = uniforms(KEY, Purpose.STATE, 0)
    assert state[0] == (draw[0] < 0.3 / 0.7)
    for n in range(1, BLOCK):
        assert state[n] == ((draw[n] >= 0.4) if state[n - 1] else (draw[n] < 0.3))
    assert not any(bad_states(KEY, 0, 0.0, 0.0))
    assert all(bad_states(KEY, 0, 0.1, 0.0))
