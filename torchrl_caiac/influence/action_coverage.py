"""How many different actions the data hold from similar states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded

from torchrl_caiac._checks import check_int
from torchrl_caiac._extras import extra
from torchrl_caiac._fit_rows import trajectory_numbers
from torchrl_caiac._keys import as_key, floating, get_leaf
from torchrl_caiac._layout_units import position_places
from torchrl_caiac._spread import spread_rows
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.modules._action_bounds import check_actions, known_bounds

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["ActionCoverage", "action_coverage"]

Verdict = Literal["few", "some", "many"]

_FEW = 0.35  # spreads below: few different actions
_MANY = 0.6
_BINS = 8  # of the range of each action column
_LEAST = 0.01  # share of the rows of a region that a bin needs to count as seen
_REGION = 5  # rows; smaller regions are left out
_TREES = 30
_LEAF = 5  # rows in a leaf of a tree


@dataclass(frozen=True)
class ActionCoverage:
    """How much of the action space data hold, see :func:`action_coverage`.

    Args:
        rows (int): the number of rows that were looked at.
        regions (int): the number of regions of similar states.
        predictability (float): the share of the variance of the actions that the state
            explains in trajectories that were held out (R²): close to 1 for a
            deterministic policy, 0 or below for random actions.
        spread (float): the standard deviation of what the state does not explain, over
            that of uniform actions, at most 1; the mean over action columns and rows.
        column_spread (tuple of float): the same for each action column, ``[A]``.
        seen (float): the share of the range of an action column of which a region has
            rows; the mean over action columns and rows.
        rank (float): the effective number of directions in which the unexplained part
            varies within a region, from 1 to ``A``; the mean over rows.
        narrow (float): the share of the rows in regions whose spread is below 0.35.
        verdict (str): ``"few"`` different actions from similar states (a spread below
            0.35), ``"some"``, or ``"many"`` (0.6 and more).
    """

    rows: int
    regions: int
    predictability: float
    spread: float
    column_spread: tuple[float, ...]
    seen: float
    rank: float
    narrow: float
    verdict: Verdict

    @property
    def advice(self) -> str:
        """What to do, in a sentence."""
        if self.verdict == "many":
            return (
                "The data hold many different actions from similar states: a world "
                "model can learn what other actions would do."
            )
        remedy = "add rows with random actions (random_transitions)"
        if self.verdict == "some":
            return (
                "The data hold some different actions from similar states: a world "
                "model extrapolates to the others. Compare its scores with those of "
                f"MotionInfluence, which needs none; to be sure, {remedy}."
            )
        return (
            f"The data hold few different actions from similar states: {remedy}, or "
            "use MotionInfluence or ResidualInfluence, which need none."
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns all numbers, the verdict and the advice, JSON-compatible."""
        found = {**asdict(self), "advice": self.advice}
        return {**found, "column_spread": list(self.column_spread)}

    def __str__(self) -> str:
        columns = ", ".join(f"{value:.2f}" for value in self.column_spread)
        return (
            f"{self.rows} rows in {self.regions} regions of similar states\n"
            f"the state explains {100 * max(0.0, self.predictability):.0f} % of the "
            "variance of the actions in other trajectories\n"
            f"what it does not explain has {100 * self.spread:.0f} % of the standard "
            f"deviation of random actions (by column: {columns}), in {self.rank:.1f} "
            f"of {len(self.column_spread)} directions\n"
            f"a region has seen {100 * self.seen:.0f} % of the range of each action\n"
            f"{self.advice}"
        )


def action_coverage(
    data: TensorDictBase | Sequence[TensorDictBase],
    layout: EntityLayout,
    *,
    action_spec: Bounded | None = None,
    action_key: NestedKey = "action",
    trajectory_key: NestedKey = "episode",
    num_regions: int = 64,
    max_rows: int = 20_000,
    seed: int = 0,
) -> ActionCoverage:
    """Measures how many different actions the data hold from similar states.

    A world model learns the effect of an action by comparison with other actions in
    similar states. Data of one policy may have none. The model then extrapolates to
    other actions, and so does the influence of the action.

    The action is predicted from the state, in each half of the trajectories by
    regressions that are fitted to the other half: extremely randomised trees and a
    linear one, of which the better is used for each column of the action. They read the
    state and, if ``layout.positions`` are known, the positions of the other entities
    relative to the ``fixed`` ones. The residual of the prediction is compared with
    uniform actions, in regions of similar states that k-means finds. Columns of states
    are divided by their standard deviations.

    Args:
        data (TensorDictBase or sequence of them): transitions ``[T]``; several
            datasets are looked at as one. Trajectories of different datasets are
            distinct.
        layout (EntityLayout): the entities.

    Keyword Args:
        action_spec (Bounded, optional): the action space, ``[A]``. Defaults to the
            bounds that are stored with the data, or to the range of the data.
        action_key (NestedKey): the action. Defaults to ``"action"``.
        trajectory_key (NestedKey): the trajectory ids, integers ``[T]`` or ``[T, 1]``.
            Defaults to ``"episode"``.
        num_regions (int): the largest number of regions; there are at least 20 rows for
            each. Defaults to 64.
        max_rows (int): the number of rows to look at, evenly spaced. Defaults to
            20,000, which takes seconds.
        seed (int): the seed of the trees and regions. Defaults to 0.

    Returns:
        ActionCoverage: the numbers, a verdict and what to do.

    Raises:
        ImportError: scikit-learn is not installed.
        KeyError: a key is missing in the data.
        TypeError: the action spec is not bounded.
        ValueError: there are fewer than two trajectories or 50 rows; a value is not
            finite; an action is outside of its bounds; all actions are equal.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import action_coverage
        >>> state = torch.rand(400, 2)
        >>> data = TensorDict(
        ...     {
        ...         "observation": state,
        ...         "action": 2 * state - 1,  # always the same from the same state
        ...         "episode": torch.arange(400) // 20,
        ...     },
        ...     [400],
        ... )
        >>> layout, spec = EntityLayout({"arm": [0, 1]}), Bounded(-1, 1, (2,))
        >>> report = action_coverage(data, layout, action_spec=spec)
        >>> report.verdict, report.spread < 0.3, report.predictability > 0.9
        ('few', True, True)
        >>> data["action"] = 2 * torch.rand(400, 2) - 1
        >>> action_coverage(data, layout, action_spec=spec).verdict
        'many'
    """
    check_int("num_regions", num_regions, 1)
    check_int("max_rows", max_rows, 50)
    sources = [data] if isinstance(data, TensorDictBase) else list(data)
    state, action, trajectory = _read(
        sources, layout, as_key(action_key), as_key(trajectory_key), max_rows
    )
    unit = _in_unit_box(action, sources, action_spec, as_key(action_key))
    differences = _differences(state, layout, layout.slices(sources[0][:1]))
    features = np.concatenate([state, *differences], 1)
    state, features = _standardised(state), _standardised(features)
    rest = unit - _held_out_prediction(features, unit, trajectory, seed)
    varies = unit.var(0) > 0
    explained = 1 - (rest**2).mean(0)[varies].sum() / unit.var(0)[varies].sum()
    region = _regions(state, min(num_regions, max(1, len(state) // 20)), seed)
    found = [
        (len(rows), *_measured(unit[rows], rest[rows]))
        for rows in (np.flatnonzero(region == r) for r in np.unique(region))
        if len(rows) >= _REGION
    ]
    weight = np.array([row[0] for row in found], dtype=np.float64)
    weight /= weight.sum()
    spread = np.stack([row[1] for row in found])
    seen, rank = (np.array([row[i] for row in found]) for i in (2, 3))
    mean = float(weight @ spread.mean(1))
    return ActionCoverage(
        rows=len(state),
        regions=len(found),
        predictability=float(explained),
        spread=mean,
        column_spread=tuple((weight @ spread).tolist()),
        seen=float(weight @ seen),
        rank=float(weight @ rank),
        narrow=float(weight[spread.mean(1) < _FEW].sum()),
        verdict="few" if mean < _FEW else "some" if mean < _MANY else "many",
    )


def _read(
    sources: Sequence[TensorDictBase],
    layout: EntityLayout,
    action_key: NestedKey,
    trajectory_key: NestedKey,
    max_rows: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Returns evenly spaced states ``[n, W]``, actions ``[n, A]`` and trajectories."""
    sources = [td for td in sources if td.batch_size.numel()]
    for td in sources:
        if td.batch_dims != 1:
            raise ValueError(
                f"the data have the batch size {list(td.batch_size)}, expected flat "
                "transitions [T]: use td.reshape(-1)"
            )
    total = sum(len(td) for td in sources)
    if total < 50:
        raise ValueError(
            f"the data have {total} rows, expected at least 50: give more transitions"
        )
    trajectory = trajectory_numbers(sources, trajectory_key).numpy()
    if trajectory.max() < 1:
        raise ValueError(
            "the data have a single trajectory, expected at least two, of which one "
            "half tells whether the actions of the other can be predicted: give more, "
            "or correct trajectory_key"
        )
    chosen = spread_rows(total, max_rows).numpy()
    states, actions, first = [], [], 0
    for td in sources:
        own = chosen[(chosen >= first) & (chosen < first + len(td))] - first
        part = td[torch.from_numpy(own)]
        action = get_leaf(
            part, action_key, "the data lack the action", "name it: action_key=..."
        )
        action = action.reshape(len(action), -1)
        state = layout.read(part)
        for what, x in (("the state", state), (f"{action_key!r}", action)):
            if not bool(x.isfinite().all()):
                row = int((~x.isfinite()).any(-1).nonzero()[0])
                raise ValueError(
                    f"{what} is not finite in row {int(own[row])}: remove or repair "
                    "such rows"
                )
        states.append(floating(state).double().cpu().numpy())
        actions.append(floating(action).double().cpu().numpy())
        first += len(td)
    return np.concatenate(states), np.concatenate(actions), trajectory[chosen]


def _in_unit_box(
    action: NDArray[np.float64],
    sources: Sequence[TensorDictBase],
    spec: Bounded | None,
    key: NestedKey,
) -> NDArray[np.float64]:
    """Scales actions ``[n, A]`` from their bounds to [-1, 1]."""
    bounds = known_bounds(sources, spec, action.shape[1])
    if bounds is None:
        low, high = action.min(0), action.max(0)
    else:
        check_actions(torch.from_numpy(action), *bounds, key)
        low, high = (bound.double().numpy() for bound in bounds)
    if not bool((action.var(0) > 0).any()):
        raise ValueError(
            f"all rows have the same {key!r}: the data tell nothing of what other "
            "actions do, add rows with random actions"
        )
    width = np.where(high > low, high - low, 1.0)
    return np.clip(2 * (action - low) / width - 1, -1, 1)


def _differences(
    state: NDArray[np.float64], layout: EntityLayout, slices: dict[str, slice]
) -> list[NDArray[np.float64]]:
    """Returns the positions of entities relative to the fixed ones, ``[n, 3]`` each."""
    places = {}
    for name in layout.positions:
        places[name] = state[:, slices[name]][:, position_places(layout, name)]
    return [
        place - places[reference]
        for reference in places
        for name, place in places.items()
        if reference in layout.fixed
        and name not in layout.fixed
        and place.shape == places[reference].shape
    ]


def _standardised(x: NDArray[np.float64]) -> NDArray[np.float64]:
    scale = x.std(0)
    return (x - x.mean(0)) / np.where(scale > 1e-9, scale, 1.0)


def _held_out_prediction(
    state: NDArray[np.float64],
    action: NDArray[np.float64],
    trajectory: NDArray[np.int64],
    seed: int,
) -> NDArray[np.float64]:
    """Predicts the actions of each half of the trajectories from the other half."""
    with extra("report", "action_coverage"):
        from sklearn.ensemble import ExtraTreesRegressor
        from sklearn.linear_model import Ridge

    names, number = np.unique(trajectory, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    half = (order < len(names) // 2)[number]
    models = (
        ExtraTreesRegressor(
            _TREES, min_samples_leaf=_LEAF, max_features=0.5, random_state=seed
        ),
        Ridge(),
    )
    predicted = np.empty((len(models), *action.shape))
    for model, own in zip(models, predicted, strict=True):
        for fitted, held_out in ((half, ~half), (~half, half)):
            # A single target is a column of numbers, not a matrix.
            target = action[fitted].squeeze(1) if own.shape[1] == 1 else action[fitted]
            found = model.fit(state[fitted], target).predict(state[held_out])
            own[held_out] = np.clip(found.reshape(-1, own.shape[1]), -1, 1)
    mistakes = ((predicted - action) ** 2).mean(1)
    return predicted[mistakes.argmin(0), :, np.arange(action.shape[1])].T


def _regions(state: NDArray[np.float64], count: int, seed: int) -> NDArray[np.int64]:
    """Returns the region of each state, by k-means."""
    from sklearn.cluster import MiniBatchKMeans

    means = MiniBatchKMeans(count, random_state=seed, n_init=1, batch_size=4096)
    return means.fit_predict(state).astype(np.int64)


def _measured(
    unit: NDArray[np.float64], rest: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float, float]:
    """Returns spread ``[A]``, share of the range seen, and effective rank."""
    uniform = 1 / math.sqrt(3)  # the standard deviation in [-1, 1]
    spread = np.minimum(np.sqrt((rest**2).mean(0)) / uniform, 1.0)
    place = np.minimum(((unit + 1) / 2 * _BINS).astype(np.int64), _BINS - 1)
    bins = (place[:, :, None] == np.arange(_BINS)).mean(0)
    seen = float((bins >= _LEAST).mean())
    values = np.linalg.eigvalsh(np.atleast_2d(np.cov(rest.T))).clip(1e-12)
    share = values / values.sum()
    return spread, seen, float(np.exp(-(share * np.log(share)).sum()))
