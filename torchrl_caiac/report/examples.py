"""Example counterfactuals: pictures where a simulator is known, else plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.report.figures import Marks, draw_marks, draw_plan
from torchrl_caiac.report.pictures import RenderFn, as_pictures, known_renderer
from torchrl_caiac.report.places import Place
from torchrl_caiac.report.swaps import SampledSwaps, moved_entities
from torchrl_caiac.scored import ScoredDataset
from torchrl_caiac.trajectories import TrajectoryIndex

__all__ = ["Example", "draw_examples"]

_BACKGROUND = 250  # points of the dataset behind a plot


@dataclass(frozen=True)
class Example:
    """A counterfactual sample.

    Attributes:
        row (int): the stored transition.
        trajectory (int): the id of its trajectory.
        step (int): its step in the trajectory, from 0.
        moved (tuple of str): the entities that a swap has put elsewhere.
        unmoved (tuple of str): the entities that were swapped, but whose place is about
            the same.
        influenced (tuple of str): the entities that the action influences, without
            fixed ones.
        svg (str): a plot; ``""`` if there are pictures.
        pictures (tuple of str): the addresses of two pictures, or none.
        description (str): what screen readers say.
    """

    row: int
    trajectory: int
    step: int
    moved: tuple[str, ...]
    unmoved: tuple[str, ...]
    influenced: tuple[str, ...]
    svg: str
    pictures: tuple[str, ...]
    description: str


def draw_examples(
    scored: ScoredDataset,
    swaps: SampledSwaps,
    chosen: Sequence[int],
    influenced: torch.Tensor,
    places: Mapping[str, Place],
    index: TrajectoryIndex,
    ids: Sequence[int],
    render: RenderFn | Literal["auto"] | None,
) -> tuple[list[Example], bool, str]:
    """Draws counterfactual samples.

    Args:
        scored (ScoredDataset): the scored dataset.
        swaps (SampledSwaps): the samples.
        chosen (sequence of int): which of them to draw.
        influenced (torch.Tensor): bool ``[T, N]``.
        places (mapping of str to Place): where each entity is, in layout order.
        index (TrajectoryIndex): the trajectories.
        ids (sequence of int): the id of each of them.
        render (callable, "auto" or None): as in
            :func:`~torchrl_caiac.report.write_report`.

    Returns:
        tuple: the examples; whether they are pictures; and why a known simulator could
        not render them, ``""`` if it could.
    """
    layout = scored.layout
    frames, trouble = None, ""
    if chosen:
        frames, trouble = _frames(scored, swaps, chosen, render)
    numbers = index.numbers()
    moved, _ = moved_entities(swaps, places)
    names = np.array(layout.names, dtype=object)
    examples = []
    for n, sample in enumerate(chosen):
        row = int(swaps.rows[sample])
        trajectory = int(numbers[row])
        first = index.ends[trajectory] - index.lengths[trajectory] + 1
        elsewhere, swapped = moved[sample], swaps.swapped[sample]
        moved_names = tuple(names[(swapped & elsewhere).numpy()])
        kept = tuple(
            name for name in names[influenced[row].numpy()] if name not in layout.fixed
        )
        description = (
            "A recorded state and its counterfactual. Swapped: "
            f"{', '.join(moved_names)}."
        )
        if frames is None:
            svg = _plot(swaps, sample, places, layout, f"example{n}", description)
            pictures: tuple[str, ...] = ()
        else:
            svg = ""
            pictures = as_pictures(frames[n], frames[len(chosen) + n])
        examples.append(
            Example(
                row=row,
                trajectory=ids[trajectory],
                step=int(index.position(torch.tensor(row)) - first),
                moved=moved_names,
                unmoved=tuple(names[(swapped & ~elsewhere).numpy()]),
                influenced=kept,
                svg=svg,
                pictures=pictures,
                description=description,
            )
        )
    return examples, frames is not None, trouble


def _frames(
    scored: ScoredDataset,
    swaps: SampledSwaps,
    chosen: Sequence[int],
    render: RenderFn | Literal["auto"] | None,
) -> tuple[NDArray[Any] | None, str]:
    """The frames of the recorded states, then those of the counterfactual ones."""
    try:
        found = known_renderer(scored.layout) if render == "auto" else render
        if found is None:
            return None, ""
        rows = swaps.rows[list(chosen)]
        states = torch.cat(
            [
                _states(scored, rows, values[list(chosen)])
                for values in (swaps.recorded, swaps.made)
            ]
        )
        frames = np.asarray(found(states))
    except (ImportError, RuntimeError) as error:
        if render == "auto" and isinstance(error, ModuleNotFoundError):
            return None, (
                f"the package {error.name!r} is not installed (pip install "
                "'torchrl-caiac[envs]', for OGBench 'torchrl-caiac[ogbench]')"
            )
        if render == "auto" and _is_unavailable(error):
            return None, str(error)
        raise
    if len(frames) != 2 * len(chosen):
        raise ValueError(
            f"render returned {len(frames)} frames for {2 * len(chosen)} states, "
            "expected one for each"
        )
    return frames, ""


def _is_unavailable(error: ImportError | RuntimeError) -> bool:
    if isinstance(error, ImportError):
        return True
    from torchrl_caiac.envs.rendering import RenderingUnavailable

    return isinstance(error, RenderingUnavailable)


def _states(
    scored: ScoredDataset, rows: torch.Tensor, values: torch.Tensor
) -> TensorDictBase:
    """The stored states of rows, with the features of all entities replaced."""
    layout = scored.layout
    states = TensorDict(
        {key: scored.data.get(key)[rows].clone() for key in layout.in_keys},
        [len(rows)],
    )
    for name, features in layout.slices(scored.data[:1]).items():
        own = values[:, features]
        if layout.is_flat:
            observation = states[layout.in_keys[0]]
            observation[:, list(layout.columns[name])] = own.to(observation.dtype)
            continue
        _fill(states, layout, name, own)
    return states


def _fill(
    states: TensorDictBase, layout: EntityLayout, name: str, values: torch.Tensor
) -> None:
    """Writes the flattened features of a nested entity back into its leaves."""
    key = layout.keys[name]
    entry = states[key]
    leaves = (
        [entry]
        if isinstance(entry, torch.Tensor)
        else [leaf for _, leaf in sorted(entry.items(True, True), key=_leaf_order)]
    )
    start = 0
    for leaf in leaves:
        width = leaf[0].numel()
        part = values[:, start : start + width]
        leaf.copy_(part.reshape(leaf.shape).to(leaf.dtype))
        start += width


def _leaf_order(item: tuple[Any, torch.Tensor]) -> Any:
    key = item[0]
    return key if isinstance(key, tuple) else (key,)


def _plot(
    swaps: SampledSwaps,
    sample: int,
    places: Mapping[str, Place],
    layout: EntityLayout,
    name: str,
    description: str,
) -> str:
    movable = [entity for entity in places if entity not in layout.fixed]
    as_plan = all(places[entity].is_point for entity in movable)
    step = -(-len(swaps.rows) // _BACKGROUND)
    marks: Marks = {}
    background = {}
    for number, entity in enumerate(layout.names):
        place = places[entity]
        if as_plan and not place.is_point:
            continue
        recorded = swaps.recorded[:, list(place.features)].double().numpy()
        made = swaps.made[sample, list(place.features)].double().numpy()
        if not as_plan:
            varies = int(recorded.std(0).argmax())
            recorded, made = recorded[:, varies], made[varies]
        marks = {
            **marks,
            entity: (recorded[sample], made, bool(swaps.swapped[sample, number])),
        }
        background[entity] = recorded[::step] if as_plan else recorded
    draw = draw_plan if as_plan else draw_marks
    return draw(marks, background, name=name, description=description)
