"""Arrays joined side by side."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchrl_caiac.data.join_columns import join_columns, joined_columns


@given(
    widths=st.lists(st.none() | st.integers(0, 4), min_size=1, max_size=5),
    length=st.integers(0, 4),
)
def test_the_ranges_find_each_array_again(widths, length):
    random = np.random.default_rng(0)
    shapes = [(length,) if width is None else (length, width) for width in widths]
    parts = {str(n): random.normal(size=shape) for n, shape in enumerate(shapes)}
    joined, ranges = join_columns(parts, "one"), joined_columns(parts)
    assert joined.shape == (length, sum(1 if w is None else w for w in widths))
    for name, (first, stop) in ranges.items():
        assert np.array_equal(joined[:, first:stop].ravel(), parts[name].ravel())


def test_what_has_no_columns_is_refused_by_name():
    with pytest.raises(ValueError, match=r"episode 3 .*'image': \[2, 4, 4\]"):
        join_columns({"arm": np.zeros(2), "image": np.zeros((2, 4, 4))}, "episode 3")
    with pytest.raises(ValueError, match=r"episode 3 .*'arm': 2, 'cup': 3"):
        join_columns({"arm": np.zeros(2), "cup": np.zeros((3, 1))}, "episode 3")
