"""Counterfactual samples by causal action influence (Algorithm 1 of the paper)."""

from __future__ import annotations

import torch
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.counterfactual import CounterfactualTransform
from torchrl_caiac.transforms.donors import (
    RewardFn,
    draw_batch_donors,
    uninfluenced,
)
from torchrl_caiac.transforms.window_goal import WindowGoal

__all__ = ["CAIACTransform"]


class CAIACTransform(CounterfactualTransform):
    """Swaps entities that the agent does not influence with those of other samples.

    Appended to a replay buffer whose rows carry scores (see
    :func:`~torchrl_caiac.influence.score_buffer`), it makes the last
    ``round(counterfactual_ratio * B)`` rows of every batch counterfactual. In each of
    them, every entity whose score is at most ``threshold`` takes its state and next
    state from a donor row in which it is uninfluenced too (Algorithm 1); entities
    draw their donors independently. With ``window`` κ > 1, rows come as flat slices
    ``[B * κ]``, an entity is free if it is uninfluenced in all rows of its window
    (eq. 1), and a donor is a whole window of one trajectory. Actions and all rows
    that are not counterfactual stay as they were stored, and so does the storage.

    Goals follow the swap where the layout maps them: achieved, next achieved and
    desired goals, also under ``next``, as far as the batch has them. Rewards change
    only with ``reward_fn``.

    The batch gains two leaves: ``counterfactual_key``, bool ``[B * κ, 1]``, says that
    a row belongs to the counterfactual share (even if it had nothing to swap), and
    ``swapped_key``, bool ``[B * κ, N]``, which entities were swapped, the same for
    all rows of a window.

    Donors in the batch are always *other* windows, as they were stored; a sampler
    that draws with replacement may still hold the same rows twice. Donors from a
    buffer are any of its windows. Where an entity has no donor it stays, is not
    marked as swapped, and :attr:`no_donor_count` grows.

    Rows that are extended later, or written through this transform without scores,
    get NaN: they count as not scored, are never swapped in or out, and sampling them
    raises until they are scored.

    Args:
        layout (EntityLayout): the entities; ``fixed`` ones are never swapped.
        threshold (float): the largest score of an uninfluenced entity, θ of eq. 3.3,
            in nats for CAI. Defaults to 0.05.
        counterfactual_ratio (float): share of rows (or windows) that become
            counterfactual, in [0, 1]. Defaults to 0.5.
        swap_prob (float): probability of swapping each free entity. Defaults to 1.
        window (int): rows a window, κ. Defaults to 1.
        donors (ReplayBuffer or TensorStorage, optional): where donors are drawn, by
            default among the rows of the same batch. A buffer has to be scored, of
            the same layout, and one-dimensional. Pickling the transform pickles it.
        score_key (NestedKey): the scores, ``[*, N]``. Defaults to
            ``("caiac", "score")``.

    Keyword Args:
        reward_fn (callable, optional): ``(next_achieved [C, G], desired [C, G])`` to
            rewards ``[C]`` or ``[C, 1]``; recomputes the rewards of counterfactual
            rows.
        reward_key (NestedKey): the rewards. Defaults to ``("next", "reward")``.
        goals (WindowGoal, optional): draws the goals of donor windows of a donor
            buffer; without it they are the stored ones. Donors in the batch bring the
            goals that the batch has for them.
        generator (torch.Generator, optional): source of randomness; torch's default
            generator without it. The same state gives the same batch.
        counterfactual_key (NestedKey): see above. Defaults to
            ``("caiac", "counterfactual")``.
        swapped_key (NestedKey): see above. Defaults to ``("caiac", "swapped")``.
        relabeled_key (NestedKey): the mark of a
            :class:`~torchrl_caiac.transforms.HindsightGoal` that was appended before,
            whose relabelling is done after the swap then. Defaults to
            ``("hindsight", "relabeled")``.
        trajectory_key (NestedKey): trajectory ids, to check that windows do not cross
            trajectories and to find donor windows. Defaults to ``"episode"``.
        done_key (NestedKey): end flags, read where there are no ids. Defaults to
            ``("next", "done")``.
        check (bool): check the values of each batch: scores, windows, observations.
            On a CUDA device nothing waits for the result, so that an error comes with
            a later sample. Defaults to ``True``.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.transforms import CAIACTransform
        >>> layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
        >>> state = torch.arange(200.0).view(100, 2)
        >>> _ = rb.extend(TensorDict({
        ...     "observation": state, ("next", "observation"): state + 0.5,
        ...     ("caiac", "score"): torch.zeros(100, 2)}, [100]))
        >>> rb.append_transform(CAIACTransform(layout))  # doctest: +ELLIPSIS
        ReplayBuffer(...)
        >>> batch = rb.sample()
        >>> batch["caiac", "counterfactual"].flatten()
        tensor([False, False,  True,  True])
        >>> batch["caiac", "swapped"]
        tensor([[False, False],
                [False, False],
                [False,  True],
                [False,  True]])
    """

    draw_in_batch = staticmethod(draw_batch_donors)

    def __init__(
        self,
        layout: EntityLayout,
        threshold: float = 0.05,
        counterfactual_ratio: float = 0.5,
        swap_prob: float = 1.0,
        window: int = 1,
        donors: ReplayBuffer | TensorStorage | None = None,
        score_key: NestedKey = ("caiac", "score"),
        *,
        reward_fn: RewardFn | None = None,
        reward_key: NestedKey = ("next", "reward"),
        goals: WindowGoal | None = None,
        generator: torch.Generator | None = None,
        counterfactual_key: NestedKey = ("caiac", "counterfactual"),
        swapped_key: NestedKey = ("caiac", "swapped"),
        relabeled_key: NestedKey = ("hindsight", "relabeled"),
        trajectory_key: NestedKey = "episode",
        done_key: NestedKey = ("next", "done"),
        check: bool = True,
    ) -> None:
        super().__init__(
            layout,
            threshold=threshold,
            counterfactual_ratio=counterfactual_ratio,
            swap_prob=swap_prob,
            window=window,
            donors=donors,
            score_key=score_key,
            reward_fn=reward_fn,
            reward_key=reward_key,
            goals=goals,
            generator=generator,
            counterfactual_key=counterfactual_key,
            swapped_key=swapped_key,
            relabeled_key=relabeled_key,
            trajectory_key=trajectory_key,
            done_key=done_key,
            check=check,
        )
        self._any_fixed = bool(layout.fixed)
        self._swappable = ~layout.fixed_mask

    def uninfluenced(self, scores: torch.Tensor) -> torch.Tensor:
        """The entities of each window that may be swapped (eq. 3.3 and 1).

        Args:
            scores (torch.Tensor): ``[B * window, N]``.

        Returns:
            torch.Tensor: bool ``[B, N]``, never true for ``fixed`` entities.
        """
        free = uninfluenced(scores, self.threshold, self.window)
        if self._any_fixed:
            if self._swappable.device != free.device:
                self._swappable = self._swappable.to(free.device)
            free = free & self._swappable
        return free

    def swappable(self, scores: torch.Tensor) -> torch.Tensor:
        """The entities of each window that may be swapped, :meth:`uninfluenced`.

        Args:
            scores (torch.Tensor): ``[B * window, N]``.

        Returns:
            torch.Tensor: bool ``[B, N]``.
        """
        return self.uninfluenced(scores)
