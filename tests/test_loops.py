"""The loop that stages share."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from teaser_jax.ground.loops import until_settled


def halved(x):
    return x // 2, x // 2 == x


@pytest.mark.parametrize(
    ("iterations", "expected", "settled"), [(0, 40, False), (3, 5, False), (50, 0, True)]
)
def test_it_ends_where_nothing_changes_or_at_the_cap(iterations, expected, settled):
    found = jax.jit(lambda x, n: until_settled(halved, x, iterations=n))(jnp.int32(40), iterations)
    assert (int(found[0]), bool(found[1])) == (expected, settled)


def test_a_batch_ends_when_its_slowest_does():
    ends, settled = jax.jit(jax.vmap(lambda x: until_settled(halved, x, iterations=4)))(jnp.array([1, 40]))
    assert ends.tolist() == [0, 2]
    assert settled.tolist() == [True, False]
