"""The ready layouts by their names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from torchrl_caiac._layout_reading import name_ready_layouts
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.layouts.adroit import ADROIT
from torchrl_caiac.layouts.description import LayoutDescription
from torchrl_caiac.layouts.fetch import FETCH
from torchrl_caiac.layouts.kitchen import KITCHEN
from torchrl_caiac.layouts.metaworld import METAWORLD
from torchrl_caiac.layouts.ogbench import OGBENCH
from torchrl_caiac.layouts.robosuite import ROBOSUITE

__all__ = ["describe_layout", "layout_names", "layout_notes", "ready_layout"]

_DESCRIPTIONS = {
    description.name: description
    for description in (
        *OGBENCH,
        *FETCH,
        *KITCHEN,
        *ADROIT,
        *ROBOSUITE,
        *METAWORLD,
    )
}


def layout_names() -> tuple[str, ...]:
    """Returns the names of the ready layouts.

    Returns:
        tuple of str: the names, grouped by benchmark.

    Examples:
        >>> from torchrl_caiac.layouts import layout_names
        >>> layout_names()[:2]
        ('ogbench/cube-single', 'ogbench/cube-double')
    """
    return tuple(_DESCRIPTIONS)


def describe_layout(name: str) -> LayoutDescription:
    """Returns the description that a ready layout is made from.

    Args:
        name (str): one of :func:`layout_names`.

    Returns:
        LayoutDescription: all columns with their meanings.

    Raises:
        ValueError: there is no such layout. The message has similar names.

    Examples:
        >>> from torchrl_caiac.layouts.ready import describe_layout
        >>> describe_layout("fetch/push").columns[2].what
        'object minus gripper, m'
    """
    if name in _DESCRIPTIONS:
        return _DESCRIPTIONS[name]
    text = str(name).lower()
    similar = difflib.get_close_matches(text, _DESCRIPTIONS, n=5, cutoff=0.5)
    similar += [n for n in _DESCRIPTIONS if text and text in n and n not in similar]
    if similar:
        remedy = f"similar ones are {', '.join(similar)}"
    else:
        remedy = f"there are {', '.join(_DESCRIPTIONS)}"
    raise ValueError(
        f"there is no ready layout {name!r}: {remedy}; or write the layout of your "
        "data as a file for EntityLayout.load"
    )


def ready_layout(name: str) -> EntityLayout:
    """Returns the layout of a well-known benchmark.

    The layout has the positions of its entities, floors for every column in the units
    of the data (:attr:`EntityLayout.variance_floor`), the exact width of the
    observation, and the robot as a fixed entity. Floors are a millimetre; for joints a
    milliradian, for the orientation of loose objects the 0.03 rad that move their
    surface by a millimetre, for velocities that motion in a control step. Columns that
    depend on several entities, such as a position relative to the gripper, belong to no
    entity: :func:`layout_notes` says which, and what to do about them.

    Args:
        name (str): one of :func:`layout_names`.

    Returns:
        EntityLayout: the layout.

    Raises:
        ValueError: there is no such layout. The message has similar names.

    Examples:
        >>> from torchrl_caiac.layouts import ready_layout
        >>> layout = ready_layout("ogbench/cube-double")
        >>> layout
        EntityLayout(
            robot: observation[0:19], fixed
            cube0: observation[19:28], goal[0:3] mirrors observation[19:22]
            cube1: observation[28:37], goal[3:6] mirrors observation[28:31]
        )
        >>> layout.positions["cube0"], layout.variance_floor["cube0"][:3]
        ((19, 20, 21), (0.01, 0.01, 0.01))
    """
    return describe_layout(name).layout()


def layout_notes(name: str) -> str:
    """Returns what a user of a ready layout has to know.

    Args:
        name (str): one of :func:`layout_names`.

    Returns:
        str: some sentences: columns that are wrong after a swap, goals, versions.

    Raises:
        ValueError: there is no such layout.

    Examples:
        >>> from torchrl_caiac.layouts import layout_notes
        >>> layout_notes("fetch/reach")
        'The gripper is the only entity: nothing can be swapped.'
    """
    return describe_layout(name).notes


def _of_width(width: int) -> Iterable[str]:
    return [name for name, d in _DESCRIPTIONS.items() if d.width == width]


name_ready_layouts(_of_width)
