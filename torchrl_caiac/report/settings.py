"""How much a report shows, and of which entities."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict.utils import NestedKey

from torchrl_caiac.report.shares import EntityShares

__all__ = ["Entity", "ReportSettings"]


@dataclass(frozen=True)
class ReportSettings:
    """How much a report shows; see :func:`~torchrl_caiac.report.write_report`."""

    windows: tuple[int, ...] = (10, 20)
    trajectories: int = 4
    pairs: int = 6
    examples: int = 4
    samples: int = 20_480
    ratio: float = 0.5
    seed: int = 0
    trajectory_key: NestedKey | None = "episode"
    done_key: NestedKey | None = ("next", "done")


@dataclass(frozen=True)
class Entity:
    """A row of the report's tables.

    Attributes:
        name (str): the entity.
        fixed (bool): whether it is never swapped.
        features (str): its observation columns or key.
        places (str): the features that say where it is; ``""`` if unknown.
        floor (str): the layout's variance floor; ``""`` if unknown.
        threshold (float, optional): θ; ``None`` for fixed entities.
        confidence (str): how sure the threshold is.
        reason (str): why.
        shares (EntityShares): how often it may be swapped.
    """

    name: str
    fixed: bool
    features: str
    places: str
    floor: str
    threshold: float | None
    confidence: str
    reason: str
    shares: EntityShares
