"""Priorities of real transitions alone."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer

from torchrl_caiac import CAIACTransform, EntityLayout
from torchrl_caiac.transforms import TransformKeys, real_transitions

LAYOUT = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])


@pytest.mark.parametrize("rows", ["random", "last"])
def test_counterfactual_errors_do_not_become_priorities(rows):
    torch.manual_seed(0)
    rb = TensorDictPrioritizedReplayBuffer(
        alpha=1.0, beta=0.5, storage=LazyTensorStorage(1000), batch_size=64
    )
    rb.append_transform(CAIACTransform(LAYOUT, rows=rows))
    rb.extend(
        TensorDict(
            {
                "observation": torch.rand(1000, 2),
                "next": {"observation": torch.rand(1000, 2)},
                ("caiac", "score"): torch.zeros(1000, 2),
            },
            [1000],
        )
    )
    batch = rb.sample()
    flags = batch["caiac", "counterfactual"].flatten()
    # Real transitions have errors like all others, counterfactual ones large ones.
    batch["td_error"] = torch.where(flags, 1e6, 1.0)
    made = set(batch["index"][flags].tolist()) - set(batch["index"][~flags].tolist())
    rb.update_tensordict_priority(real_transitions(batch))
    share = sum(i in made for i in rb.sample()["index"].tolist()) / 64
    assert share < 0.2
    rb.update_tensordict_priority(batch)
    share = sum(i in made for i in rb.sample()["index"].tolist()) / 64
    assert share > 0.6


def test_batches_of_several_dimensions_and_other_keys():
    flags = torch.tensor([[[True], [False]], [[False], [False]]])
    batch = TensorDict({"x": torch.arange(4).view(2, 2), "flag": flags}, [2, 2])
    keys = TransformKeys(counterfactual="flag")
    assert real_transitions(batch, keys)["x"].tolist() == [1, 2, 3]
    with pytest.raises(KeyError, match=r"'caiac', 'counterfactual'.*TransformKeys"):
        real_transitions(batch)
