"""Counterfactual samples by causal action influence (Algorithm 1 of the paper)."""

from __future__ import annotations

import math
from typing import Literal

import torch
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.threshold_rule import DEFAULT_THRESHOLD
from torchrl_caiac.transforms.counterfactual import CounterfactualTransform
from torchrl_caiac.transforms.draws import draw_batch_donors, uninfluenced
from torchrl_caiac.transforms.goals.window import WindowGoal
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.lookahead import LookaheadArgument
from torchrl_caiac.transforms.rewards import RewardFn, TerminatedFn
from torchrl_caiac.transforms.thresholds import ThresholdArgument

__all__ = ["CAIACTransform"]


class CAIACTransform(CounterfactualTransform):
    """Swaps entities that the agent does not influence with those of other samples.

    Append it to a replay buffer whose rows have scores (see
    :func:`~torchrl_caiac.influence.score_buffer`). It makes
    ``round(counterfactual_ratio * B)`` rows of every batch counterfactual: every entity
    whose score is at most ``threshold`` takes its state and next state from a donor row
    in which it is uninfluenced too (Algorithm 1). Entities draw their donors
    independently. With ``window`` κ > 1, batches are flat slices ``[B * κ]``, an entity
    may be swapped if it is uninfluenced in all rows of its window (eq. 1), and a donor
    is a whole window of one trajectory. Actions, all rows that are not counterfactual,
    and the storage never change.

    Goals follow the swap if the layout maps them: achieved, next achieved and desired
    goals, also under ``next``, if the batch has them. Rewards change only with
    ``reward_fn``. Append :class:`~torchrl_caiac.transforms.WindowGoal` before this
    transform and :class:`~torchrl_caiac.transforms.HindsightGoal` after it.

    Two leaves are added to the batch: ``keys.counterfactual``, bool ``[B * κ, 1]``,
    flags the counterfactual rows (even if there was nothing to swap), and
    ``keys.swapped``, bool ``[B * κ, N]``, the entities that were swapped, the same for
    all rows of a window.

    Donors in the batch are always *other* windows, as they were stored; a sampler that
    draws with replacement may still return the same rows twice. Donors from a buffer
    can be any of its eligible windows. An entity without a donor is neither swapped nor
    flagged as swapped, and increases :attr:`no_donor_count`.

    A score that :func:`~torchrl_caiac.influence.score_buffer` wrote is used only for
    the state that it was computed from: it has a fingerprint of the state and the next
    state, which is compared in every batch. Rows that were written later, by any
    process, raise an error (see ``unscored``) until ``score_buffer`` is called again.
    Append this transform before others that change the state. Scores that you wrote
    yourself, without fingerprints, are used as they are: if you overwrite rows, write
    their scores too.

    Args:
        layout (EntityLayout): the entities; ``fixed`` ones are never swapped.
        threshold (float, mapping of str to float or str): the largest score of an
            uninfluenced entity, θ of section 3.3, in nats for CAI. One number, or one
            for each entity that is not fixed, where a number below 0 means that the
            entity is never swapped. ``"auto"``: chosen at the first sample by
            :func:`~torchrl_caiac.influence.suggest_thresholds` from the scores of the
            buffer that samples, logged, and kept in :attr:`thresholds`; entities
            without a clear threshold are never swapped, and a warning names them.
            Defaults to 0.05.
        counterfactual_ratio (float): share of rows (or windows) that become
            counterfactual, in [0, 1]. Defaults to 0.5.

    Keyword Args:
        rows (str): which rows (or windows) become counterfactual. ``"random"``: drawn
            in each batch; ``"last"``: the last ones, for a
            :class:`~torchrl.data.HERReplayBuffer`, which relabels the first ones.
            Defaults to ``"random"``.
        swap_prob (float): probability of swapping each uninfluenced entity. Defaults
            to 1.
        window (int): rows in a window, κ. Defaults to 1.
        lookahead (int, str or None): whether influence that comes later in the
            trajectory counts too. A policy acts for what comes next: while the hand
            moves to the cup, a cup that is swapped away leaves its action without a
            reason. ``"next"``: the entity that is influenced next is not swapped
            either, nor is it a donor. A number L: nor are entities that are influenced
            in one of the L states after the row (or after the last row of the window).
            ``"goal"``: nor are, besides the next one, entities that are influenced
            before the goal that :class:`~torchrl_caiac.transforms.WindowGoal` drew for
            the row. A swapped entity then does not move between the row and its goal.
            ``None``: only the row's own score counts, as in Algorithm 1. All but
            ``None`` read the trajectories of the buffer that samples (one buffer, no
            :class:`~torchrl.data.ReplayBufferEnsemble`), and of the donor buffer. This
            takes one byte per entity and row of the storage's capacity, or two bytes
            with ``"goal"``. Defaults to ``None``.
        donors (ReplayBuffer or TensorStorage, optional): where donors are drawn from.
            Defaults to the rows of the same batch. A donor buffer needs scores of the
            same estimator, and the same layout. It is pickled with the transform.
        score_key (NestedKey): the scores, ``[*, N]``. Defaults to
            ``("caiac", "score")``.
        unscored (str): what happens to rows that have no score, or one of another
            state. ``"raise"``: an error; ``"keep"``: they neither swap nor donate, and
            :attr:`unscored_count` counts them. Defaults to ``"raise"``.
        reward_fn (callable, optional): ``(next_achieved [C, G], desired [C, G])`` to
            rewards ``[C]`` or ``[C, 1]``; recomputes the rewards of counterfactual
            rows. Other forms, such as Gymnasium's ``compute_reward``, and the dtype of
            the rewards are as in :class:`~torchrl_caiac.transforms.HindsightGoal`.
            Defaults to ``None``: the stored rewards are kept.
        terminated_fn (callable, optional): the same forms, to bool ``[C]`` or
            ``[C, 1]``; recomputes the end flags of counterfactual rows, for tasks that
            end at their goal. Defaults to ``None``: end flags are kept, and with a
            ``reward_fn`` a warning says so once if some of them end the task.
        goals (WindowGoal, optional): draws the goals of donor windows of a donor
            buffer; without it they are the stored ones. Donors in the batch keep the
            goals that they have in the batch.
        generator (torch.Generator, optional): source of randomness. Defaults to
            torch's default generator. The same state gives the same batch.
        keys (TransformKeys, optional): rewards, actions, trajectory ids, end flags and
            the flags that are written. Defaults to ``TransformKeys()``.
        check (bool): check the values of each batch: scores, windows, observations. On
            a CUDA device nothing waits for the result, so an error is raised at a later
            sample. Defaults to ``True``.

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
        >>> _ = rb.append_transform(CAIACTransform(layout, rows="last"))
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
        threshold: ThresholdArgument = DEFAULT_THRESHOLD,
        counterfactual_ratio: float = 0.5,
        *,
        rows: Literal["random", "last"] = "random",
        swap_prob: float = 1.0,
        window: int = 1,
        lookahead: LookaheadArgument = None,
        donors: ReplayBuffer | TensorStorage | None = None,
        score_key: NestedKey = ("caiac", "score"),
        unscored: Literal["raise", "keep"] = "raise",
        reward_fn: RewardFn | None = None,
        terminated_fn: TerminatedFn | None = None,
        goals: WindowGoal | None = None,
        generator: torch.Generator | None = None,
        keys: TransformKeys | None = None,
        check: bool = True,
    ) -> None:
        super().__init__(
            layout,
            threshold,
            counterfactual_ratio,
            rows=rows,
            swap_prob=swap_prob,
            window=window,
            lookahead=lookahead,
            donors=donors,
            score_key=score_key,
            unscored=unscored,
            reward_fn=reward_fn,
            terminated_fn=terminated_fn,
            goals=goals,
            generator=generator,
            keys=keys,
            check=check,
        )
        # The limits of all entities, and what they were made from.
        self._limits: tuple[float | torch.Tensor, torch.Tensor] | None = None

    def swappable(self, scores: torch.Tensor) -> torch.Tensor:
        """Returns the entities of each window that may be swapped (section 3.3, eq. 1).

        Args:
            scores (torch.Tensor): ``[B * window, N]``.

        Returns:
            torch.Tensor: bool ``[B, N]``, never true for ``fixed`` entities.
        """
        limit = self._thresholds.limit(scores)
        known = self._limits
        dtype = scores.dtype if scores.is_floating_point() else torch.float32
        if (
            known is None
            or known[0] is not limit
            or (known[1].device, known[1].dtype) != (scores.device, dtype)
        ):
            numbers = limit
            if not isinstance(numbers, torch.Tensor):
                numbers = torch.tensor(limit, dtype=torch.float64, device="cpu")
                numbers = numbers.to(scores.device, dtype).expand(len(self.layout))
            # No score is at most NaN.
            fixed = self.layout.fixed_mask.to(scores.device)
            numbers = numbers.masked_fill(fixed, math.nan)
            known = self._limits = limit, numbers
        return uninfluenced(scores, known[1], self.window)
