"""Counterfactual transitions, sampled from a replay buffer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_caiac.data import offline_buffer
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.transforms import CAIACTransform

__all__ = ["counterfactual_transitions"]

_BATCH = 4096
_MOST_EMPTY = 100  # batches without a swap, before giving up


def counterfactual_transitions(
    scored: ScoredDataset,
    data: TensorDictBase,
    count: int,
    generator: torch.Generator,
    **options: Any,
) -> Iterator[TensorDictBase]:
    """Yields counterfactual transitions, as training on a buffer would see them.

    Rows in which nothing is swapped are left out: they would be copies.

    Args:
        scored (ScoredDataset): the dataset.
        data (TensorDictBase): its transitions, ``[T]``, with scores and the entries
            that are wanted.
        count (int): the number of transitions.
        generator (torch.Generator): source of randomness.
        **options (Any): further arguments of
            :class:`~torchrl_caiac.transforms.CAIACTransform`, such as ``reward_fn``.

    Yields:
        TensorDictBase: rows ``[B]`` with the transform's flags, ``count`` in total.

    Raises:
        ValueError: nothing is swapped in hundreds of thousands of rows.
    """
    rb = offline_buffer(data, batch_size=min(_BATCH, 4 * count + 64))
    rb.set_rng(generator)
    transform = CAIACTransform(
        scored.layout,
        scored.thresholds,
        counterfactual_ratio=1.0,
        donors=offline_buffer(data, batch_size=1),
        score_key=scored.score_key,
        generator=generator,
        **options,
    )
    rb.append_transform(transform)
    empty = 0
    while count:
        batch = rb.sample()
        rows = batch[batch[transform.keys.swapped].any(-1)][:count]
        empty = 0 if len(rows) else empty + 1
        if empty > _MOST_EMPTY:
            raise ValueError(
                f"in {empty * len(batch)} rows nothing was swapped: every entity is "
                "influenced (nearly) always by these thresholds; look at the report, "
                "and score with another estimator or a lower lookahead"
            )
        if len(rows):
            count -= len(rows)
            yield rows
