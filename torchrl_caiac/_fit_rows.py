"""The rows that a world model is fitted to, of one or several datasets."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import floating, get_leaf
from torchrl_caiac.modules._action_bounds import check_actions, is_one_hot
from torchrl_caiac.modules.entity_dynamics_model import EntityDynamicsModel
from torchrl_caiac.trajectories import trajectory_index

__all__ = ["CHUNK", "FitRows", "split_rows", "trajectory_numbers"]

CHUNK = 65_536  # rows read from the data at once
_NOT_CONTINUOUS = (
    "but world models read continuous actions: for discrete ones use MotionInfluence "
    "or ResidualInfluence"
)


class FitRows:
    """The columns that the model reads, of several datasets, by row number."""

    def __init__(
        self,
        model: EntityDynamicsModel,
        sources: Sequence[TensorDictBase],
        max_memory: int,
        bounds: tuple[torch.Tensor, torch.Tensor] | None,
    ) -> None:
        self.model, self.sources, self.bounds = model, sources, bounds
        for td in sources:
            if td.batch_dims != 1:
                raise ValueError(
                    f"the data have the batch size {list(td.batch_size)}, expected "
                    "flat transitions [T]: use td.reshape(-1)"
                )
        self.lengths = [len(td) for td in sources]
        total = sum(self.lengths)
        if not total:
            raise ValueError("the data are empty: collect or load transitions first")
        self.starts = torch.tensor([0, *self.lengths]).cumsum(0)
        self.sizes = [model.state_dim, model.action_dim, model.predict_dim]
        width = sum(self.sizes)
        self.device = model.device
        self.block: torch.Tensor | None = None
        if total * width * 4 <= max_memory:
            self.block = torch.empty(total, width)
        self.checksum = 0
        self.action_range = (
            torch.full((model.action_dim,), math.inf),
            torch.full((model.action_dim,), -math.inf),
        )
        is_discrete = True
        for first, part in self._chunks():
            action = part.split(self.sizes, 1)[1]
            self.action_range = (
                torch.minimum(self.action_range[0], action.amin(0)),
                torch.maximum(self.action_range[1], action.amax(0)),
            )
            self.checksum = zlib.crc32(part.numpy().data, self.checksum)
            is_discrete = is_discrete and is_one_hot(action)
            if self.block is not None:
                self.block[first : first + len(part)] = part
        if is_discrete:
            raise ValueError(
                f"{model.action_key!r} is one-hot in all rows, {_NOT_CONTINUOUS}"
            )
        if self.block is not None:
            self.block = self.block.to(self.device)

    def _chunks(self) -> Iterator[tuple[int, torch.Tensor]]:
        model = self.model
        first = 0
        for td in self.sources:
            for start in range(0, len(td), CHUNK):
                part = td[start : start + CHUNK]
                action = get_leaf(
                    part,
                    model.action_key,
                    "the data lack the action",
                    "name its leaf with the model's action_key",
                )
                if not action.is_floating_point():
                    raise ValueError(
                        f"{model.action_key!r} is {action.dtype}, {_NOT_CONTINUOUS}. "
                        "Convert actions that are amounts to floating point"
                    )
                state = model.layout.read(part)
                after = model.layout.read(part, next=True)
                own = "give the data that the model's layout describes"
                vectors = "store them as [T, A], or correct the model's action_dim"
                for what, x, size, remedy in (
                    ("the entities' features", state, model.state_dim, own),
                    ("the entities' next features", after, model.state_dim, own),
                    (f"{model.action_key!r}", action, model.action_dim, vectors),
                ):
                    if tuple(x.shape) != (len(part), size):
                        raise ValueError(
                            f"the shape of {what} is {list(x.shape)}, expected "
                            f"{[len(part), size]}: {remedy}"
                        )
                model.check_finite(state, first_row=first)
                model.check_finite(after, next=True, first_row=first)
                model.check_finite_action(action, first_row=first)
                if self.bounds is not None:
                    check_actions(
                        action, *self.bounds, model.action_key, first_row=first
                    )
                yield first, self._columns(state, action, after)
                first += len(part)

    def _columns(
        self, state: torch.Tensor, action: torch.Tensor, after: torch.Tensor
    ) -> torch.Tensor:
        # The change is computed before the cast, to keep small changes of float64 data.
        state, action, after = state.cpu(), action.cpu(), after.cpu()
        index = self.model.index.cpu()
        raw = floating(after[:, index])
        if self.model.target == "change":
            raw = raw - floating(state[:, index])
        return torch.cat([state.float(), action.float(), raw.float()], 1)

    def get(self, index: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Returns states, actions and raw targets of rows, on the model's device."""
        if self.block is not None:
            return self.block[index.to(self.device)].split(self.sizes, 1)
        model, layout = self.model, self.model.layout
        out = torch.empty(len(index), sum(self.sizes))
        source = torch.bucketize(index, self.starts[1:], right=True)
        for number, td in enumerate(self.sources):
            where = (source == number).nonzero()[:, 0]
            if len(where):
                part = td[index[where] - self.starts[number]]
                out[where] = self._columns(
                    layout.read(part),
                    part.get(model.action_key),
                    layout.read(part, next=True),
                )
        return out.to(self.device).split(self.sizes, 1)

    def raw_targets(self, index: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yields the raw targets of rows, in chunks."""
        for part in index.split(CHUNK):
            yield self.get(part)[2]


def trajectory_numbers(
    sources: Sequence[TensorDictBase], key: NestedKey
) -> torch.Tensor:
    """Returns the number of each row's trajectory, int64 ``[T]``."""
    parts: list[torch.Tensor] = []
    offset = 0
    for td in sources:
        if not len(td):
            continue
        ids = get_leaf(
            td,
            key,
            "the data lack the trajectory key",
            "name the leaf that has the trajectory ids, so that whole trajectories can "
            "be held out for validation",
        )
        if ids.is_floating_point():
            raise ValueError(f"{key!r} is {ids.dtype}, expected integers")
        index = trajectory_index(td, trajectory_key=key, done_key=None)
        # Numbered by id, so that the split does not depend on the order of the data.
        group = ids.reshape(-1)[index.starts].unique(return_inverse=True)[1]
        parts.append(group[index.numbers()].cpu() + offset)
        offset = int(parts[-1].max()) + 1
    return torch.cat(parts)


def split_rows(
    trajectory: torch.Tensor,
    fraction: float,
    max_validation_rows: int,
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the rows for training and for validation, in whole trajectories."""
    count = int(trajectory.max()) + 1
    if count < 2:
        raise ValueError(
            "the data contain a single trajectory, expected at least two, one of them "
            "for validation: collect more, or correct trajectory_key"
        )
    held_out = min(max(1, round(fraction * count)), count - 1)
    validates = torch.zeros(count, dtype=torch.bool)
    validates[torch.randperm(count, generator=generator)[:held_out]] = True
    mask = validates[trajectory]
    validation = mask.nonzero()[:, 0]
    if len(validation) > max_validation_rows:
        choice = torch.randperm(len(validation), generator=generator)
        validation = validation[choice[:max_validation_rows]].sort().values
    return (~mask).nonzero()[:, 0], validation
