"""Evaluation of influence estimators by ground truth and by the resulting swaps."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDictBase

from torchrl_caiac.data.offline_buffer import offline_buffer
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.metrics import influence_report
from torchrl_caiac.influence.score_buffer import score_buffer

if TYPE_CHECKING:
    from torchrl_caiac.transforms.counterfactual import CounterfactualTransform

__all__ = [
    "COLUMNS",
    "Candidate",
    "SwapShares",
    "compare_influence",
    "swap_shares",
]

_RATES = ("auc", "true_positive_rate", "false_positive_rate", "best_threshold")
#: The columns of the table that :func:`compare_influence` returns.
COLUMNS = (
    "estimator",
    "entity",
    "threshold",
    *_RATES,
    "infeasible",
    "density",
    "rows_swapped",
    "fit_seconds",
    "score_seconds",
)


class Candidate(NamedTuple):
    """An estimator and a transform that reads its scores.

    Attributes:
        estimator (callable): as in :func:`~torchrl_caiac.influence.score_buffer`; its
            scores are the influence of the action, ``[n, N]``, or graphs,
            ``[n, N + 1, N]``.
        transform (CounterfactualTransform): a :class:`~torchrl_caiac.CAIACTransform` or
            a :class:`~torchrl_caiac.CoDATransform` with single-row windows and donors
            in the batch. Its threshold is θ; its keys do not matter.
        smoothing (int): as in :func:`~torchrl_caiac.influence.score_buffer`.
        fit_seconds (float): the time that fitting took, which is reported; NaN if
            unknown.
    """

    estimator: Callable[[TensorDictBase], torch.Tensor]
    transform: CounterfactualTransform
    smoothing: int = 1
    fit_seconds: float = math.nan


class SwapShares(NamedTuple):
    """How many swaps there are, and how many of them are infeasible.

    Attributes:
        rows (float): the share of counterfactual rows in which an entity is swapped.
        infeasible (torch.Tensor): the share of the swaps of each entity in which the
            action influences it in its own row or in the donor's; float64 ``[N]``, NaN
            for an entity that is never swapped.
        infeasible_total (float): the same share over all entities.
    """

    rows: float
    infeasible: torch.Tensor
    infeasible_total: float


def swap_shares(
    transform: CounterfactualTransform,
    scores: torch.Tensor,
    influenced: torch.Tensor,
    *,
    batch_size: int = 512,
    batches: int = 200,
    seed: int = 0,
) -> SwapShares:
    """Compares the swaps of a transform with the ground truth.

    A swap is infeasible if, by the ground truth, the action influences the swapped
    entity: the action then causes its motion, and is not swapped.

    Args:
        transform (CounterfactualTransform): a transform with single-row windows and
            donors in the batch.
        scores (torch.Tensor): the scores that the transform reads,
            ``[T, *feature_shape]``.
        influenced (torch.Tensor): the ground truth, bool ``[T, N]``.

    Keyword Args:
        batch_size (int): the number of rows in a batch. Defaults to 512.
        batches (int): the number of batches. Defaults to 200.
        seed (int): the seed of the draws. Defaults to 0.

    Returns:
        SwapShares: the shares.

    Raises:
        ValueError: the transform has longer windows, lookahead or a donor buffer, or
            the shapes do not fit.

    Examples:
        >>> import torch
        >>> from torchrl_caiac import CAIACTransform, EntityLayout
        >>> from torchrl_caiac.evaluation import swap_shares
        >>> layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
        >>> truth = torch.tensor([[True, False], [True, True]]).repeat(50, 1)
        >>> swap_shares(CAIACTransform(layout), truth.float(), truth).infeasible_total
        0.0
    """
    if transform.window != 1 or transform.donors is not None:
        raise ValueError(
            f"the transform has windows of {transform.window} rows and donors "
            f"{transform.donors!r}: give one with window=1 and donors=None"
        )
    if transform.lookahead is not None:
        raise ValueError(
            f"the transform has lookahead={transform.lookahead!r}, which reads "
            "trajectories: give one with lookahead=None"
        )
    expected = (len(influenced), *transform.feature_shape)
    if tuple(scores.shape) != expected or influenced.shape[1:] != expected[-1:]:
        raise ValueError(
            f"scores and influenced have the shapes {list(scores.shape)} and "
            f"{list(influenced.shape)}, expected {list(expected)} and "
            f"[T, {expected[-1]}]"
        )
    generator = torch.Generator().manual_seed(seed)
    rows = total = 0
    swaps = torch.zeros(expected[-1], dtype=torch.int64)
    infeasible = torch.zeros(expected[-1], dtype=torch.int64)
    for _ in range(batches):
        choice = torch.randint(len(scores), (batch_size,), generator=generator)
        draw = transform.generate_parameters(scores[choice], generator)
        truth = influenced[choice]
        own = truth[batch_size - len(draw.swapped) :]
        donors = truth.gather(0, draw.donors.where(draw.swapped, 0))
        rows += int(draw.swapped.any(-1).sum())
        total += len(own) if draw.chosen is None else int(draw.chosen.sum())
        swaps += draw.swapped.sum(0)
        infeasible += (draw.swapped & (own | donors)).sum(0)
    return SwapShares(
        rows / total if total else math.nan,
        infeasible.double() / swaps,
        (infeasible.sum().double() / swaps.sum()).item(),
    )


def compare_influence(
    data: TensorDictBase,
    influenced: torch.Tensor,
    candidates: Mapping[str, Candidate],
    *,
    batch_size: int = 4096,
    seed: int = 0,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Compares estimators with the ground truth, all on the same rows.

    Args:
        data (TensorDictBase): transitions ``[T]`` of whole trajectories, with the keys
            that the estimators read; they are not changed.
        influenced (torch.Tensor): the ground truth for the state of each row, bool
            ``[T, N]``, see :func:`~torchrl_caiac.influence.true_influence`.
        candidates (mapping of str to Candidate): the estimators by name.

    Keyword Args:
        batch_size (int): the number of states scored at once. Defaults to 4096.
        seed (int): the seed of the swaps. Defaults to 0.
        progress (bool): show progress bars. Defaults to ``True``.

    Returns:
        list of dict: for each estimator one row with ``"entity": "all"`` and one for
        each entity that is not fixed, in the columns :data:`COLUMNS`:

        - ``"estimator"`` and ``"threshold"``, θ; for all entities NaN if each has its
          own;
        - ``"auc"``, ``"true_positive_rate"``, ``"false_positive_rate"`` and
          ``"best_threshold"`` of the influence of the action, see
          :class:`~torchrl_caiac.influence.EntityReport`; for all entities, the mean
          over those that have an AUC;
        - ``"infeasible"``, the share of infeasible swaps, see :func:`swap_shares`;
        - for all entities only: ``"density"``, the share of scored links above θ;
          ``"rows_swapped"``; ``"fit_seconds"``; and ``"score_seconds"``, the processor
          time for all rows.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import CAIACTransform, EntityLayout
        >>> from torchrl_caiac.influence import DistanceInfluence
        >>> from torchrl_caiac.evaluation import Candidate, compare_influence
        >>> layout = EntityLayout({"arm": [0], "cup": [1]}, fixed=["arm"])
        >>> rule = DistanceInfluence(layout, {"arm": [0], "cup": [1]}, action_only=True)
        >>> state = torch.rand(60, 2)
        >>> data = TensorDict({
        ...     "observation": state, "episode": torch.arange(60) // 20,
        ...     "next": {"observation": state,
        ...              "done": (torch.arange(60) % 20 == 19)[:, None]}}, [60])
        >>> near = (state - state[:, :1]).abs() <= 0.1
        >>> rows = compare_influence(
        ...     data, near, {"distance": Candidate(rule, CAIACTransform(layout, 0.5))},
        ...     progress=False)
        >>> [(row["entity"], row["auc"], row["infeasible"]) for row in rows]
        [('all', 1.0, 0.0), ('cup', 1.0, 0.0)]
    """
    rows = []
    for name, candidate in candidates.items():
        transform = candidate.transform
        layout, theta = transform.layout, transform.threshold
        thetas = transform.thresholds
        if theta == "auto" and not thetas:
            raise ValueError(
                f"the transform of {name!r} has threshold='auto', and no numbers yet: "
                "give numbers, such as suggest_thresholds(...).thresholds"
            )
        rb = offline_buffer(data.clone(), batch_size=1)
        begin = _cpu_seconds()
        score_buffer(
            rb,
            candidate.estimator,
            batch_size=batch_size,
            smoothing=candidate.smoothing,
            lookahead=0,
            key="score",
            check=False,  # of the next states nothing is read
            progress=progress,
        )
        seconds = _cpu_seconds() - begin
        scores = rb.storage[:]["score"]
        report: dict[str, Any] = dict(
            influence_report(
                scores if scores.ndim == 2 else scores[:, -1],
                influenced,
                layout.names,
                threshold=theta if isinstance(theta, float) else thetas,
            )
        )
        swaps = swap_shares(transform, scores, influenced, seed=seed)
        common = {"estimator": name}
        entities: list[dict[str, Any]] = [
            {
                **common,
                "threshold": thetas[entity],
                "entity": entity,
                **{key: report[entity][key] for key in _RATES},
                "infeasible": swaps.infeasible[layout.index(entity)].item(),
            }
            for entity in layout.names
            if entity not in layout.fixed
        ]
        with_auc = [row for row in entities if not math.isnan(row["auc"])]
        rows.append(
            {
                **common,
                "threshold": theta if isinstance(theta, float) else math.nan,
                "entity": "all",
                **{
                    key: fmean(row[key] for row in with_auc) if with_auc else math.nan
                    for key in _RATES
                },
                "infeasible": swaps.infeasible_total,
                "density": _density(scores, layout, thetas),
                "rows_swapped": swaps.rows,
                "fit_seconds": candidate.fit_seconds,
                "score_seconds": seconds,
            }
        )
        rows += entities
    return rows


def _cpu_seconds() -> float:
    """Returns the processor time of this process and of its finished children."""
    return time.process_time() + sum(os.times()[2:4])


def _density(
    scores: torch.Tensor, layout: EntityLayout, thresholds: Mapping[str, float]
) -> float:
    """Returns the share of scored links above the thresholds."""
    fixed = layout.fixed_mask
    # Fixed entities have no threshold of their own, but their links in graphs count:
    # graphs have one threshold for all.
    some = next(iter(thresholds.values()), 0.0)
    limits = torch.tensor([thresholds.get(name, some) for name in layout.names])
    above = scores > limits.to(scores.device, scores.dtype)
    if scores.ndim == 2:  # without fixed entities, which the action always influences
        scored = (~fixed).expand_as(scores)
    else:  # without the links from an entity to itself
        n = scores.shape[-1]
        scored = (~torch.eye(n + 1, n, dtype=torch.bool)).expand_as(scores)
    return above[scored].double().mean().item()
