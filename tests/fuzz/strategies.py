"""Hypothesis strategies: damaged trees, texts, bytes and recordings of each kind of file."""

from __future__ import annotations

import copy

from hypothesis import strategies as st

from . import corpus, mutate, targets

numbers = st.integers() | st.floats() | st.sampled_from([0, -1, 1e300, 1e-300, float("nan"), float("inf")])
leaves = (
    st.none()
    | st.booleans()
    | numbers
    | st.text(max_size=30)
    | st.sampled_from([x for x in mutate.ODD if not isinstance(x, (list, dict))])
)
plain = st.recursive(
    leaves,
    lambda x: st.lists(x, max_size=4) | st.dictionaries(st.text(max_size=10) | st.integers(), x, max_size=4),
    max_leaves=10,
)
"""Any plain data."""
kinds = st.sampled_from(sorted(targets.TARGETS))
seeds = st.integers(0, 2**40)


@st.composite
def trees(draw, kind: str):
    """Return a sound tree of a kind with one place exchanged for anything."""
    root = [copy.deepcopy(corpus.TREES[kind])]
    node, key = root, 0
    for _ in range(draw(st.integers(0, 6))):
        inner = node[key]
        keys = (
            sorted(inner, key=str)
            if isinstance(inner, dict)
            else list(range(len(inner)))
            if isinstance(inner, list)
            else []
        )
        if not keys:
            break
        node, key = inner, draw(st.sampled_from(keys))
    node[key] = draw(plain)
    return root[0]
