"""Goals from the future of a trajectory: the base of all goal transforms."""

from __future__ import annotations

import threading
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import ReplayBufferEnsemble, TensorStorage
from torchrl.data.replay_buffers import SampleUnit

from torchrl_caiac._buffer_transform import RandomTransform
from torchrl_caiac._keys import join, missing_key, path
from torchrl_caiac._sampling import is_native, read_ahead, read_columns
from torchrl_caiac._torchrl import leaf_of, sampling_buffer, storage_rows
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.trajectories import TrajectoryIndex
from torchrl_caiac.trajectory_cache import TrajectoryCache
from torchrl_caiac.transforms.checks import check_generator, check_layout
from torchrl_caiac.transforms.goals.offsets import check_probability
from torchrl_caiac.transforms.indexing import pick_places, pick_rows, plain_tensor
from torchrl_caiac.transforms.keys import TransformKeys

__all__ = ["FutureGoal"]

_COMPARED = 10  # batches, with the rows that the buffer drew


class FutureGoal(RandomTransform, SampleUnit):
    """Draws goals from a storage in ``expand``, for ``forward`` to write.

    The base of :class:`~torchrl_caiac.transforms.WindowGoal` and
    :class:`~torchrl_caiac.transforms.HindsightGoal`, which are both the
    ``sample_unit`` of a replay buffer and one of its transforms.

    Args:
        layout (EntityLayout): the entities and their goals.

    Keyword Args:
        p (float): the parameter of the geometric distribution.
        generator (torch.Generator, optional): source of randomness.
        keys (TransformKeys, optional): the keys other than those of the layout.

    Raises:
        TypeError: an argument has the wrong type.
        ValueError: ``p`` is out of range, or the layout has no goals.
    """

    def __init__(
        self,
        layout: EntityLayout,
        *,
        p: float,
        generator: torch.Generator | None,
        keys: TransformKeys | None,
    ) -> None:
        super().__init__(check_generator(generator))
        check_layout(layout)
        self.p = check_probability(p)
        if not any(layout.goal.values()):
            raise ValueError(
                "the layout has no goals: give EntityLayout(..., goal=..., "
                "achieved=...)"
            )
        if not layout.is_flat:
            blind = [
                name
                for name, key in layout.goal.items()
                if key is not None and layout.achieved.get(name) is None
            ]
            if blind:
                raise ValueError(
                    f"the layout does not say where the achieved goals of {blind} are: "
                    "give EntityLayout.from_keys(..., achieved=...)"
                )
        self.layout = layout
        self.keys = keys or TransformKeys()
        if layout.is_flat and layout.achieved:
            key: NestedKey = layout.next(layout.observation_key)
            self._goal_columns = key, layout.goal_columns()
        elif layout.is_flat:
            columns = tuple(range(layout.goal_width))
            self._goal_columns = layout.next(layout.achieved_goal_key), columns
        self._reset_state()

    def _reset_state(self) -> None:
        # Separate for each thread: a buffer prefetches in threads, which draw and
        # apply.
        self._pending = threading.local()
        self._to_compare = _COMPARED
        self._cache = TrajectoryCache(
            trajectory_key=self.keys.trajectory, done_key=self.keys.done
        )

    @property
    def goal_keys(self) -> list[NestedKey]:
        """The desired goals of the layout."""
        if self.layout.is_flat:
            return [self.layout.desired_goal_key]
        return [key for key in self.layout.goal.values() if key is not None]

    @property
    def goal_columns(self) -> tuple[int, ...]:
        """The columns of the leaf that the goals of a flat layout are read from."""
        return tuple(self._goal_columns[1])

    @property
    def reads_by_layout(self) -> bool:
        """Whether goals are what the layout says, as no subclass reads its own."""
        return type(self).read_goals is FutureGoal.read_goals

    @property
    def achieved_keys(self) -> list[NestedKey]:
        """The leaves, of the next state, that goals are read from."""
        if self.layout.is_flat:
            return [self._goal_columns[0]]
        layout = self.layout
        return [layout.next(k) for k in layout.achieved.values() if k is not None]

    def stored(self, storage: Any) -> tuple[TensorDictBase, TrajectoryIndex]:
        """Returns the data of the buffer's storage, and its trajectories.

        Args:
            storage (TensorStorage): the sampled storage.

        Returns:
            tuple: the storage's rows ``[T]``, not copied, and the index.
        """
        data = storage_rows(storage, "the buffer")
        assert isinstance(storage, TensorStorage)  # else storage_rows raised
        return data, self._cache.get(storage)

    def keep_goals(self, goals: dict[NestedKey, torch.Tensor]) -> None:
        """Keeps the goals of a batch until :meth:`take_goals`, in the same thread.

        Args:
            goals (dict): the goals by desired-goal leaf.
        """
        self._pending.goals = goals, sampling_buffer() is not None

    def keep_own(self, data: TensorDictBase, rows: torch.Tensor) -> None:
        """Keeps what the drawn rows achieve, to compare the first batches with it.

        Args:
            data (TensorDictBase): the rows of the storage, ``[T]``.
            rows (torch.Tensor): int64 ``[B]``, those that were drawn.
        """
        if self._to_compare:
            # On an accelerator the host waits for the comparison, so only once.
            is_on_cpu = rows.device.type == "cpu"
            self._to_compare = self._to_compare - 1 if is_on_cpu else 0
            self._pending.own = self.read_goals(data, rows)
        else:  # nor those of a sample that failed
            self._pending.own = None

    def check_own(self, td: TensorDictBase) -> None:
        """Raises if the rows of a batch are not those that the buffer drew.

        Goals come from the storage. After a transform that changes the states, or the
        order of rows, they would be those of other states.

        Args:
            td (TensorDictBase): the batch, ``[B]``, with counterfactuals or not.

        Raises:
            ValueError: the real rows achieve something else.
        """
        drawn = self._pending.__dict__.pop("own", None)
        if drawn is None or sampling_buffer() is None:
            return
        if any(leaf_of(td, key) is None for key in self.achieved_keys):
            return  # left out of the batch, which goals are not read from
        td = td.reshape(-1)
        flags = leaf_of(td, self.keys.counterfactual)
        for key, achieved in self.read_goals(td).items():
            own = drawn.get(key, None)
            if own is None or own.shape != achieved.shape:
                continue  # another error says more
            own = own.to(achieved)
            differ = (own != achieved) & ~(own.isnan() & achieved.isnan())
            differ = differ.reshape(len(differ), -1).any(1)
            if flags is not None:
                differ &= ~flags.reshape(-1)
            if bool(differ.any()):
                raise ValueError(
                    f"the next states of {int(differ.sum())} of {len(differ)} rows are "
                    "not those that the buffer drew, from which goals are taken: "
                    f"append {type(self).__name__} before transforms that change or "
                    "reorder rows, such as a normalisation"
                )

    def take_goals(self) -> dict[NestedKey, torch.Tensor] | None:
        """Returns the goals that were kept for this batch, and forgets them.

        Returns:
            dict, optional: the goals; ``None`` if there are none, or if they are those
            of a sample that failed, since this batch was not sampled.
        """
        goals, is_sample = self._pending.__dict__.pop("goals", (None, False))
        return None if is_sample and sampling_buffer() is None else goals

    def no_goals(self, otherwise: str = "") -> RuntimeError:
        """Returns the error for a batch whose goals were not drawn.

        Args:
            otherwise (str): what else could be done. Defaults to nothing.

        Returns:
            RuntimeError: to be raised; it says what to do.
        """
        name = type(self).__name__
        if isinstance(sampling_buffer(), ReplayBufferEnsemble):
            return RuntimeError(
                "a ReplayBufferEnsemble samples its buffers without their sample_unit, "
                f"where {name} draws goals: sample from each buffer by itself, or from "
                f"two by offline_to_online_buffer{otherwise}"
            )
        return RuntimeError(
            f"no future goals were drawn for this batch: pass the same {name} as "
            "sample_unit=... of the replay buffer, and get data by rb.sample() "
            f"(rb.storage[...] reads rows as they are stored){otherwise}. For a buffer "
            "in another process, create a CAIACReplayBuffer there, since both would be "
            "sent apart"
        )

    # --- reading ---------------------------------------------------------------------

    def flat_source(self, data: TensorDictBase) -> torch.Tensor:
        """Returns the leaf that a flat layout's goals are read from.

        Args:
            data (TensorDictBase): the data, ``[T]``.

        Returns:
            torch.Tensor: ``[T, D]``.

        Raises:
            KeyError: the data lack the leaf.
            ValueError: it has too few columns.
        """
        key, columns = self._goal_columns
        source = leaf_of(data, key)
        if source is None:
            raise missing_key(
                data,
                key,
                "the data lack the leaf that goals are read from,",
                "give the layout `achieved` columns, or store the achieved goals",
            )
        if source.ndim != 2 or source.shape[-1] <= max(columns):
            raise ValueError(
                f"{key!r} has {source.shape[-1]} columns in {source.ndim} dimensions, "
                f"but the layout's goals need [T, D] with at least {max(columns) + 1}: "
                "correct the layout, or the data"
            )
        return plain_tensor(source)

    def goal_index(self, device: torch.device) -> torch.Tensor:
        """Returns :attr:`goal_columns` on a device, int64 ``[G]``."""
        key, columns = self._goal_columns
        return self.layout.index_tensor(("goal", key), columns, device)

    def nested_source(self, data: TensorDictBase, name: str) -> Any:
        """Returns the leaf or tensordict that an entity's goal is read from.

        Args:
            data (TensorDictBase): the data, ``[T]``.
            name (str): the entity.

        Returns:
            torch.Tensor or TensorDictBase: ``[T, ...]``.

        Raises:
            KeyError: the data lack it.
        """
        key = self.layout.next(self.layout.achieved[name])
        source = data.get(key, None)
        if source is None:
            raise missing_key(
                data,
                key,
                f"the data lack the leaf that the goals of {name!r} are read from,",
                "correct `achieved` in EntityLayout.from_keys",
            )
        return plain_tensor(source) if isinstance(source, torch.Tensor) else source

    def read_goals(
        self, data: TensorDictBase, rows: torch.Tensor | None = None
    ) -> dict[NestedKey, torch.Tensor]:
        """Reads the goals that the next states of rows achieve.

        Args:
            data (TensorDictBase): what ``rows`` are rows of, ``[T]``.
            rows (torch.Tensor, optional): int64 ``[M]``; all rows by default.

        Returns:
            dict: the goals ``[M, ...]`` by the desired-goal leaf they belong in, in
            layout order.

        Raises:
            KeyError: the data lack the leaf that goals are read from.
        """
        layout = self.layout
        if layout.is_flat:
            source = self.flat_source(data)
            numbers = source if rows is None else rows
            is_vector = rows is None or (rows.ndim, rows.dtype) == (1, torch.int64)
            if is_vector and is_native(numbers, sources=[source]):
                goals = read_columns(source, self._goal_columns[1], rows)
            elif rows is None:
                where = self.goal_index(source.device)
                goals = source.gather(1, where.expand(source.shape[0], -1))
            else:
                rows = rows.to(source.device).unsqueeze(-1)
                where = self.goal_index(source.device)
                places = torch.add(where, rows, alpha=source.shape[-1])
                goals = pick_places(source, places.flatten()).view(places.shape)
            return {layout.desired_goal_key: goals}
        found: dict[NestedKey, torch.Tensor] = {}
        for name in layout.names:
            key = layout.goal.get(name)
            if key is None:
                continue
            source = self.nested_source(data, name)
            if isinstance(source, torch.Tensor):
                found[key] = source
                continue
            for below in sorted(map(path, source.keys(True, True))):
                found[join(key, below)] = plain_tensor(source.get(below))
        if rows is not None:
            found = {key: pick_rows(leaf, rows) for key, leaf in found.items()}
        return found

    def read_goals_ahead(
        self,
        data: TensorDictBase,
        trajectories: TrajectoryIndex,
        rows: torch.Tensor,
        steps: torch.Tensor,
    ) -> dict[NestedKey, torch.Tensor]:
        """Reads goals some steps after rows, at most at the trajectory's end.

        Args:
            data (TensorDictBase): what ``rows`` are rows of, ``[T]``.
            trajectories (TrajectoryIndex): its trajectories.
            rows (torch.Tensor): int64 ``[M]``.
            steps (torch.Tensor): int64 ``[M]``, at least 0.

        Returns:
            dict: the goals ``[M, ...]``, as of :meth:`read_goals`.

        Raises:
            IndexError: a row is out of range.
            KeyError: the data lack the leaf that goals are read from.
        """
        source = None
        if (steps.dtype, steps.shape) == (torch.int64, rows.shape):
            source = self.source_in_c(data, trajectories, rows, steps)
        if source is not None:
            columns, left = self._goal_columns[1], trajectories.left
            goals = read_ahead(source, columns, rows, steps, left)
            return {self.layout.desired_goal_key: goals}
        return self.read_goals(data, trajectories.ahead(rows, steps))

    def source_in_c(
        self,
        data: TensorDictBase,
        trajectories: TrajectoryIndex,
        rows: torch.Tensor,
        *numbers: torch.Tensor,
    ) -> torch.Tensor | None:
        """Returns the leaf of goals if functions in C can read goals ahead of rows.

        Args:
            data (TensorDictBase): what ``rows`` are rows of, ``[T]``.
            trajectories (TrajectoryIndex): its trajectories.
            rows (torch.Tensor): integer ``[M]``.
            *numbers (torch.Tensor): what else the function reads.

        Returns:
            torch.Tensor, optional: ``[T, D]``, as of :meth:`flat_source`; ``None`` if
            goals are read by :meth:`read_goals`.

        Raises:
            KeyError: the data lack the leaf.
            ValueError: it has too few columns.
        """
        left = trajectories.left
        if (
            not (self.layout.is_flat and self.reads_by_layout)
            or trajectories.order is not None
            or (rows.ndim, rows.dtype, rows.device.type) != (1, torch.int64, "cpu")
            or left.dtype not in (torch.int32, torch.int64)
        ):
            return None
        source = self.flat_source(data)
        if len(left) > len(source):
            return None
        return source if is_native(rows, *numbers, sources=[source, left]) else None

    # --- copying ---------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"

    def clone(self) -> FutureGoal:
        """Returns a copy with its own pending goals."""
        clone: FutureGoal = super().clone()
        clone._reset_state()
        return clone

    def __getstate__(self) -> dict[str, Any]:
        state: dict[str, Any] = super().__getstate__()
        del state["_pending"], state["_cache"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._reset_state()
