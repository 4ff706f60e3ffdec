"""The README's figure: a demonstration frame next to a counterfactual of it.

``make demo`` collects and scores the demonstrations. This script samples
counterfactuals of one of their frames with :class:`~torchrl_caiac.CAIACTransform`,
renders both, and outlines the swapped and the influenced object::

    python docs/figures/before_after.py outputs/franka_kitchen \\
        docs/images/before_after.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy import ndimage

from torchrl_caiac import CAIACTransform
from torchrl_caiac.data import load_transitions
from torchrl_caiac.envs import KITCHEN_TASKS, KitchenEnv

LAYOUT = KitchenEnv.layout
SWAPPED, INFLUENCED = "slide_cabinet", "microwave"
COLOURS = {SWAPPED: "#E69F00", INFLUENCED: "#56B4E9"}  # Okabe and Ito
SIZE = (1600, 1200)  # of the rendered frames, pixels
CROP = (slice(0, 1090), slice(20, 1580))  # rows and columns that are shown
COPIES, BATCH = 64, 512


def counterfactual(path: Path, threshold: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A state late in a microwave demonstration, and a counterfactual of it."""
    data = load_transitions(path)
    own = data["task"] == KITCHEN_TASKS.index("microwave")
    demonstration = (data["episode"] == data["episode"][own][0]).nonzero()
    row = demonstration[int(0.93 * len(demonstration))]
    torch.manual_seed(0)
    # The last rows of a batch become counterfactual; the others are their donors.
    donors = torch.randint(len(data), (BATCH - COPIES,))
    transform = CAIACTransform(
        LAYOUT,
        threshold=threshold,
        counterfactual_ratio=COPIES / BATCH,
        rows="last",
    )
    batch = transform(data[torch.cat([donors, row.expand(COPIES)])])
    recorded, made = data["observation"][row], batch["observation"][-COPIES:]
    swapped = batch["caiac", "swapped"][-COPIES:]
    if swapped[:, LAYOUT.names.index(INFLUENCED)].any():
        raise RuntimeError(f"{INFLUENCED} was swapped: is it uninfluenced in this row?")
    column = LAYOUT.columns[SWAPPED][0]
    changed = (made[:, column] - recorded[:, column]).abs()
    best = int(changed.argmax())
    if changed[best] < 0.1:
        raise RuntimeError(f"no counterfactual has {SWAPPED} in another place")
    return recorded[0], made[best]


def visible(env: KitchenEnv, states: torch.Tensor, entity: str) -> NDArray[np.bool_]:
    """The pixels ``[S, H, W]`` in which an entity is seen."""
    model = env.model
    moved = {
        body
        for body, address in zip(model.jnt_bodyid, model.jnt_qposadr, strict=True)
        if address in LAYOUT.columns[entity]
    }
    geoms = [i for i, body in enumerate(model.geom_bodyid) if body in moved]
    rgba, material = model.geom_rgba.copy(), model.geom_matid.copy()
    # Two renderings with the entity in different colours differ where it is visible.
    frames = []
    for colour in ([1.0, 0.0, 1.0], [0.0, 1.0, 0.0]):
        model.geom_matid[geoms] = -1
        model.geom_rgba[geoms, :3] = colour
        frames.append(env.render_states(states.numpy()).astype(np.int16))
    model.geom_rgba[:], model.geom_matid[:] = rgba, material
    return np.abs(frames[0] - frames[1]).max(-1) > 20


def outline(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without small islands, and closed at the edges of the picture."""
    regions, _ = ndimage.label(ndimage.binary_closing(mask, iterations=4))
    sizes = np.bincount(regions.ravel())
    sizes[0] = 0
    kept = regions == sizes.argmax()
    kept[:4], kept[-4:], kept[:, :4], kept[:, -4:] = False, False, False, False
    return kept


def draw(frames: NDArray[np.uint8], masks: dict[str, NDArray[np.bool_]]) -> Figure:
    """Both frames, with the entities of the masks ``[2, H, W]`` outlined."""
    figure = Figure(
        figsize=(8, 3.4), dpi=200, layout=ConstrainedLayoutEngine(h_pad=0.06)
    )
    titles = "recorded: cabinet open", "counterfactual: cabinet closed"
    for i, title in enumerate(titles):
        axes = figure.add_subplot(1, 2, i + 1)
        axes.imshow(frames[i][CROP])
        axes.set_axis_off()
        axes.set_title(title, fontsize=11)
        for entity, mask in masks.items():
            axes.contour(
                outline(mask[i][CROP]), [0.5], colors=COLOURS[entity], linewidths=2.4
            ).set_path_effects([withStroke(linewidth=4.2, foreground="white")])
    figure.legend(
        handles=[
            Line2D([], [], color=COLOURS[name], lw=3, label=text)
            for name, text in (
                (SWAPPED, "cabinet: not influenced, swapped"),
                (INFLUENCED, "microwave: influenced, kept"),
            )
        ],
        loc="outside lower center",
        ncols=2,
        frameon=False,
        fontsize=11,
    )
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("demo", type=Path, help="output folder of make demo")
    parser.add_argument("figure", type=Path, help="the PNG file to write")
    parser.add_argument("--threshold", type=float, default=0.3)
    options = parser.parse_args()
    states = torch.stack(
        counterfactual(options.demo / "demonstrations", options.threshold)
    )
    env = KitchenEnv(render_mode="rgb_array", render_size=SIZE)
    try:
        frames = env.render_states(states.numpy())
        masks = {entity: visible(env, states, entity) for entity in COLOURS}
    finally:
        env.close()
    draw(frames, masks).savefig(options.figure, bbox_inches="tight", pad_inches=0.08)


if __name__ == "__main__":
    main()
