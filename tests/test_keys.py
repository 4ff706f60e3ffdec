from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_caiac._keys import as_key, floating, get_leaf, missing_key


@pytest.mark.parametrize("key", [3, (), ("a", 1), ("a", ()), (("a", None), "b")])
def test_no_key(key):
    with pytest.raises(TypeError, match="a str or a tuple of str, got"):
        as_key(key)


def test_get_leaf_names_what_is_there_and_what_to_do():
    td = TensorDict({"a": torch.zeros(2), "next": {"b": torch.ones(2)}}, [2])
    assert get_leaf(td, ("next", "b"), "the data lack", "add it").sum() == 2
    with pytest.raises(KeyError, match=r"the data lack .*c.*; they have .*a.*: add it"):
        get_leaf(td, "c", "the data lack", "add it")
    with pytest.raises(TypeError, match="'next' is a TensorDict, expected a tensor"):
        get_leaf(td, "next", "the data lack", "add it")
    error = missing_key(td, ["x", "y"], "lack", "add them")
    assert error.args[0].startswith("lack 'x' and 'y'; they have")


@pytest.mark.parametrize(
    "dtype",
    [
        *(torch.uint8, torch.int8, torch.int16, torch.uint16, torch.bool),
        *(torch.int32, torch.uint32, torch.int64, torch.float16, torch.float64),
    ],
)
def test_floating_point_holds_every_value(dtype):
    if dtype == torch.bool:
        values = [False, True]
    elif dtype.is_floating_point:
        values = [0.5, -2.0]
    else:
        limits = torch.iinfo(dtype)
        values = [limits.min + 1, min(limits.max, 2**53) - 1]
    found = floating(torch.tensor(values, dtype=dtype))
    assert found.is_floating_point()
    if dtype == torch.int64:
        values[0] = float(values[0])  # no floating point holds 64 bits
    assert found.tolist() == values
    if dtype.is_floating_point:
        assert found.dtype == dtype
