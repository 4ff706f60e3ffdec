"""Counterfactual samples by the components of a local causal graph (CoDA)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict.utils import NestedKey
from torchrl.data import ReplayBuffer, TensorStorage

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.transforms.checks import check_number
from torchrl_caiac.transforms.components import (
    MAX_ENTITIES,
    ComponentDonors,
    components,
    draw_batch_components,
)
from torchrl_caiac.transforms.counterfactual import CounterfactualTransform
from torchrl_caiac.transforms.goals.window import WindowGoal
from torchrl_caiac.transforms.keys import TransformKeys
from torchrl_caiac.transforms.lookahead import LookaheadArgument
from torchrl_caiac.transforms.rewards import RewardFn, TerminatedFn

__all__ = ["CoDATransform"]


class CoDATransform(CounterfactualTransform):
    """Swaps independent parts of a state with those of other samples (CoDA).

    The baseline of Pitis et al. (2020) that the paper compares with. Each row has a
    graph of local influence, from the entities and the action to the entities (see
    :class:`~torchrl_caiac.influence.AttentionInfluence`). Scores above ``threshold``
    are links, in either direction, and links form connected components. In
    ``round(counterfactual_ratio * B)`` rows of a batch, every component that does not
    contain the action takes its states and next states from a donor row in which the
    same set of entities is a component without the action too. Components draw their
    donors independently; the entities of one component share a donor. With ``window`` κ
    > 1, entities belong together if they are linked in any row of the window.

    A component that contains a ``fixed`` entity is not swapped. Goals, rewards, flags,
    checks, donors in the batch or from a buffer, unscored rows, missing donors and the
    order of transforms are as in :class:`~torchrl_caiac.CAIACTransform`, which with the
    scores of the action alone (``AttentionInfluence(model, action_only=True)``) is
    CoDA-action.

    Args:
        layout (EntityLayout): at most 64 entities.
        threshold (float): scores above it are links, θ. One number, since a link
            belongs to two entities. Defaults to 0.2.
        counterfactual_ratio (float): share of rows (or windows) that become
            counterfactual, in [0, 1]. Defaults to 0.5.

    Keyword Args:
        rows (str): which rows (or windows) become counterfactual. ``"random"``: drawn
            in each batch; ``"last"``: the last ones, for a
            :class:`~torchrl.data.HERReplayBuffer`, which relabels the first ones.
            Defaults to ``"random"``.
        swap_prob (float): probability of swapping each component. Defaults to 1.
        window (int): rows in a window, κ. Defaults to 1.
        lookahead (int, str or None): as in :class:`~torchrl_caiac.CAIACTransform`. An
            entity is influenced where its component contains the action or a fixed
            entity. Defaults to ``None``.
        donors (ReplayBuffer or TensorStorage, optional): where donors are drawn from.
            Defaults to the rows of the same batch. A donor buffer needs graphs and the
            same layout. It is pickled with the transform.
        graph_key (NestedKey): the graphs, ``[*, N + 1, N]``: from the row (the
            entities in layout order, then the action) to the column. Defaults to
            ``("coda", "graph")``.
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
            buffer; without it they are the stored ones.
        generator (torch.Generator, optional): source of randomness. Defaults to
            torch's default generator. The same state gives the same batch.
        keys (TransformKeys, optional): rewards, actions, trajectory ids, end flags and
            the flags that are written. Defaults to ``TransformKeys()``.
        check (bool): check the values of each batch: graphs, windows, observations; on
            a CUDA device an error is raised at a later sample. Defaults to ``True``.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: an argument is out of range, or there are more than 64 entities.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac import CoDATransform, EntityLayout
        >>> layout = EntityLayout(
        ...     {"arm": [0], "cup": [1], "lid": [2], "box": [3]}, fixed=["arm"]
        ... )
        >>> graph = torch.zeros(5, 4)  # from arm, cup, lid, box, action
        >>> graph[1, 2] = graph[4, 0] = 1.0  # the cup moves the lid, the action the arm
        >>> rb = ReplayBuffer(storage=LazyTensorStorage(100), batch_size=2)
        >>> state = torch.arange(400.0).view(100, 4)
        >>> _ = rb.extend(TensorDict({
        ...     "observation": state, ("next", "observation"): state + 0.5,
        ...     ("coda", "graph"): graph.expand(100, 5, 4)}, [100]))
        >>> _ = rb.append_transform(CoDATransform(layout, rows="last"))
        >>> batch = rb.sample()
        >>> batch["caiac", "swapped"]
        tensor([[False, False, False, False],
                [False,  True,  True,  True]])
        >>> _, cup, lid, _ = batch["observation"][1]
        >>> lid - cup  # still those of one row
        tensor(1.)
    """

    draw_in_batch = staticmethod(draw_batch_components)
    donors_class = ComponentDonors
    _expected = "a score from each entity and the action to each of"

    def __init__(
        self,
        layout: EntityLayout,
        threshold: float = 0.2,
        counterfactual_ratio: float = 0.5,
        *,
        rows: Literal["random", "last"] = "random",
        swap_prob: float = 1.0,
        window: int = 1,
        lookahead: LookaheadArgument = None,
        donors: ReplayBuffer | TensorStorage | None = None,
        graph_key: NestedKey = ("coda", "graph"),
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
            _one_number(threshold),
            counterfactual_ratio,
            rows=rows,
            swap_prob=swap_prob,
            window=window,
            lookahead=lookahead,
            donors=donors,
            score_key=graph_key,
            unscored=unscored,
            reward_fn=reward_fn,
            terminated_fn=terminated_fn,
            goals=goals,
            generator=generator,
            keys=keys,
            check=check,
        )
        if len(layout) > MAX_ENTITIES:
            raise ValueError(
                f"the layout has {len(layout)} entities, but components are bit masks "
                f"of at most {MAX_ENTITIES}: join entities that always move together"
            )
        self._fixed = layout.fixed_mask

    @property
    def graph_key(self) -> NestedKey:
        """The key of the graphs."""
        return self.score_key

    @property
    def feature_shape(self) -> tuple[int, ...]:
        """The shape of one row's graph, ``(N + 1, N)``."""
        return len(self.layout) + 1, len(self.layout)

    def swappable(self, scores: torch.Tensor) -> torch.Tensor:
        """Returns the swappable components of each window, see :func:`components`.

        Args:
            scores (torch.Tensor): the graphs ``[B * window, N + 1, N]``.

        Returns:
            torch.Tensor: int64 ``[B, N]``, the component of each entity as a bit mask,
            0 where it contains the action or a fixed entity.
        """
        if self._fixed.device != scores.device:
            self._fixed = self._fixed.to(scores.device)
        theta = self._thresholds.number
        return components(scores, theta, window=self.window, fixed=self._fixed)


def _one_number(threshold: Any) -> float:
    """Returns the threshold, or raises if it is for each entity or chosen."""
    if isinstance(threshold, (Mapping, str)):
        raise TypeError(
            "CoDATransform has one graph of links between entities, and one threshold "
            f"for all of them: pass a number, got {threshold!r}. CAIACTransform takes "
            "one for each entity"
        )
    return check_number("threshold", threshold, math.inf)
