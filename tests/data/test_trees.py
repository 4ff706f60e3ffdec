from __future__ import annotations

import numpy as np

from torchrl_caiac.data.trees import copy_tree, index_tree, stack_trees


def test_stacks_and_their_entries():
    trees = [{"a": np.arange(3) + i, "b": {"c": np.float32(i)}} for i in range(4)]
    stacked = stack_trees(trees)
    assert stacked["a"].shape == (4, 3)
    assert stacked["b"]["c"].dtype == np.float32
    for index, tree in enumerate(trees):
        back = index_tree(stacked, index)
        np.testing.assert_array_equal(back["a"], tree["a"])
        assert back["b"]["c"] == tree["b"]["c"]
    np.testing.assert_array_equal(stack_trees([np.arange(2)] * 3), [[0, 1]] * 3)


def test_copies_share_no_memory():
    tree = {"a": np.zeros(2), "b": {"c": np.zeros(3)}}
    copied = copy_tree(tree)
    tree["a"] += 1
    tree["b"]["c"] += 1
    assert copied["a"].sum() == copied["b"]["c"].sum() == 0
