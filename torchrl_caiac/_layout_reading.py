"""Reading the entries of transitions that an entity layout names."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._keys import flatten, missing_key

if TYPE_CHECKING:
    from torchrl_caiac.entities import EntityLayout

__all__ = [
    "check_data",
    "check_width",
    "name_ready_layouts",
    "read_entities",
    "read_observation",
]


# The ready layouts of a width, for error messages. They come later in the imports.
_ready_layouts: list[Callable[[int], Iterable[str]]] = []


def name_ready_layouts(names: Callable[[int], Iterable[str]]) -> None:
    """Lets error messages name the ready layouts that have the width of the data.

    Args:
        names (Callable): returns the names of the layouts of a width.

    Examples:
        >>> from torchrl_caiac._layout_reading import name_ready_layouts
        >>> name_ready_layouts(lambda width: ())
    """
    _ready_layouts.append(names)


def read_observation(
    layout: EntityLayout, td: TensorDictBase, *, next: bool = False
) -> torch.Tensor:
    """Returns the observation of a flat layout, after checking it.

    Args:
        layout (EntityLayout): a flat layout.
        td (TensorDictBase): transitions ``[*B]``.

    Keyword Args:
        next (bool): read the next state. Defaults to ``False``.

    Returns:
        torch.Tensor: ``[*B, D]``.

    Raises:
        KeyError: the observation is missing.
        TypeError: the observation is not a tensor.
        ValueError: the observation has too few dimensions or columns.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_reading import read_observation
        >>> td = TensorDict({"observation": torch.zeros(5, 2)}, [5])
        >>> read_observation(EntityLayout({"arm": [0, 1]}), td).shape
        torch.Size([5, 2])
    """
    assert layout.observation_key is not None  # the layout is flat
    key = layout.observation_key
    key = layout.next(key) if next else key
    observation = _get(td, key)
    if not isinstance(observation, torch.Tensor):
        raise TypeError(
            f"{key!r} is a {type(observation).__name__}, but a flat layout names "
            "columns of a tensor: use EntityLayout.from_keys for nested entities"
        )
    if observation.ndim <= td.batch_dims:
        raise ValueError(
            f"{key!r} has shape {list(observation.shape)}, expected [*B, D] with batch "
            f"dimensions {list(td.batch_size)}"
        )
    check_width(layout, observation.shape[-1], key)
    return observation


def read_entities(
    layout: EntityLayout, td: TensorDictBase, *, next: bool = False
) -> dict[str, torch.Tensor]:
    """Returns the features of each entity of a nested layout.

    Args:
        layout (EntityLayout): a nested layout.
        td (TensorDictBase): transitions ``[*B]``.

    Keyword Args:
        next (bool): read the next state. Defaults to ``False``.

    Returns:
        dict of str to torch.Tensor: ``[*B, W]`` for each entity, in layout order.

    Raises:
        KeyError: an entity is missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_reading import read_entities
        >>> td = TensorDict({"arm": torch.zeros(5, 2, 3)}, [5])
        >>> read_entities(EntityLayout.from_keys({"arm": "arm"}), td)["arm"].shape
        torch.Size([5, 6])
    """
    return {
        name: flatten(_get(td, layout.next(key) if next else key), td.batch_dims)
        for name, key in layout.keys.items()
    }


def check_width(layout: EntityLayout, width: int, key: NestedKey | None = None) -> None:
    """Raises if a flat layout names columns that an observation does not have.

    Args:
        layout (EntityLayout): a flat layout.
        width (int): the width of the observation.
        key (NestedKey, optional): the observation's key in error messages. Defaults to
            the layout's own.

    Raises:
        ValueError: the observation is too narrow, or has not the layout's own width.

    Examples:
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_reading import check_width
        >>> check_width(EntityLayout({"arm": [0, 3]}), 4)
    """
    if layout.width not in (None, width):
        others = [name for names in _ready_layouts for name in names(width)]
        remedy = "take the layout of these data, or correct the data"
        if others:
            remedy += f" (ready layouts of this width: {', '.join(others)})"
        raise ValueError(
            f"{key or layout.observation_key!r} has {width} columns, but the layout is "
            f"for {layout.width}: {remedy}"
        )
    needed = 1 + max(max(columns) for columns in layout.columns.values())
    if width < needed:
        raise ValueError(
            f"{key or layout.observation_key!r} has {width} columns, but the layout "
            f"needs at least {needed}: correct the columns of the entities or the data"
        )


def check_data(layout: EntityLayout, td: TensorDictBase, *, next: bool = False) -> None:
    """Raises if a layout does not fit the data: see ``EntityLayout.check``.

    Args:
        layout (EntityLayout): the layout.
        td (TensorDictBase): transitions ``[*B]``.

    Keyword Args:
        next (bool): check the next state too. Defaults to ``False``.

    Raises:
        KeyError: a key is missing.
        TypeError: the observation or the goal of a flat layout is not a tensor.
        ValueError: an observation or a goal has the wrong width.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac._layout_reading import check_data
        >>> td = TensorDict({"observation": torch.zeros(5, 2)}, [5])
        >>> check_data(EntityLayout({"arm": [0, 1]}), td)
    """
    for after in (False, True) if next else (False,):
        if layout.is_flat:
            read_observation(layout, td, next=after)
        else:
            read_entities(layout, td, next=after)
    if not layout.is_flat or not layout.goal:
        return
    keys = [layout.desired_goal_key, layout.achieved_goal_key]
    if next:
        keys.append(layout.next(layout.achieved_goal_key))
    for key in keys:
        goal = td.get(key, None)
        if goal is not None and not isinstance(goal, torch.Tensor):
            raise TypeError(
                f"{key!r} is a {type(goal).__name__}, but the goals of a flat layout "
                "are vectors: leave the entry out of the data, or store one vector"
            )
        if goal is not None and goal.shape[-1] != layout.goal_width:
            raise ValueError(
                f"{key!r} has {goal.shape[-1]} columns, but the layout's goal has "
                f"{layout.goal_width}: correct goal= or the data"
            )


def _get(td: TensorDictBase, key: NestedKey) -> Any:
    value = td.get(key, None)
    if value is None:
        raise missing_key(
            td,
            key,
            "the data lack the entry that the layout reads from",
            "rename the entry, or correct the layout",
        )
    return value
