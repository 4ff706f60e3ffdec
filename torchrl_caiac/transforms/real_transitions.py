"""The transitions of a batch that are not counterfactual."""

from __future__ import annotations

from tensordict import TensorDictBase

from torchrl_caiac._keys import missing_key
from torchrl_caiac.transforms.keys import TransformKeys

__all__ = ["real_transitions"]


def real_transitions(
    batch: TensorDictBase, keys: TransformKeys | None = None
) -> TensorDictBase:
    """Returns the transitions of a batch that are not counterfactual.

    For prioritized sampling: the TD error of a counterfactual transition says nothing
    about the stored one that it was made from, so only those of real transitions may
    become priorities, ``rb.update_tensordict_priority(real_transitions(batch))``.

    Args:
        batch (TensorDictBase): the batch ``[*B]``, as it was sampled or with more
            leaves.
        keys (TransformKeys, optional): the flag of counterfactual transitions. Defaults
            to ``TransformKeys()``.

    Returns:
        TensorDictBase: the real transitions, ``[M]``.

    Raises:
        KeyError: the batch has no flag.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import (
        ...     LazyTensorStorage,
        ...     TensorDictPrioritizedReplayBuffer,
        ... )
        >>> from torchrl_caiac import CAIACTransform, EntityLayout
        >>> from torchrl_caiac.transforms import real_transitions
        >>> rb = TensorDictPrioritizedReplayBuffer(
        ...     alpha=0.7, beta=0.5, storage=LazyTensorStorage(20), batch_size=8
        ... )
        >>> _ = rb.append_transform(CAIACTransform(EntityLayout({"cup": [0]})))
        >>> state, after = torch.rand(2, 20, 1)
        >>> _ = rb.extend(TensorDict({
        ...     "observation": state, ("next", "observation"): after,
        ...     ("caiac", "score"): torch.zeros(20, 1)}, [20]))
        >>> batch = rb.sample()
        >>> batch["td_error"] = torch.rand(8)  # by a loss
        >>> rb.update_tensordict_priority(real_transitions(batch))
        >>> real_transitions(batch).batch_size
        torch.Size([4])
    """
    key = (keys or TransformKeys()).counterfactual
    flags = batch.get(key, None)
    if flags is None:
        raise missing_key(
            batch,
            key,
            "the batch lacks the flag of counterfactual transitions",
            "sample it from a buffer with the augmentation, or name the flag with "
            "keys=TransformKeys(counterfactual=...)",
        )
    return batch.reshape(-1)[~flags.reshape(-1)]
