"""What a reader of a report should know before using the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from torchrl_caiac.check import DatasetReport
from torchrl_caiac.report.settings import Entity
from torchrl_caiac.report.swaps import SampledSwaps

__all__ = ["Problem", "find_problems"]

# What ``suggest_thresholds`` says of thresholds.
NEVER_INFLUENCED = "one mode: never influenced"
UNCLEAR = "unclear"


@dataclass(frozen=True)
class Problem:
    """Something that a reader should know before using the data.

    Attributes:
        severity (str): ``"error"``, ``"warning"`` or ``"note"``.
        text (str): what was found.
        effect (str): what it does; ``""`` if the text says it.
        remedy (str): what to do; ``""`` for nothing.
    """

    severity: Literal["error", "warning", "note"]
    text: str
    effect: str = ""
    remedy: str = ""


def find_problems(
    check: DatasetReport,
    warnings: Sequence[str],
    entities: Sequence[Entity],
    swaps: SampledSwaps,
    no_pictures: str,
) -> list[Problem]:
    """Collects what a reader should know.

    Args:
        check (DatasetReport): the check of the dataset.
        warnings (sequence of str): what was said when it was scored.
        entities (sequence of Entity): the entities.
        swaps (SampledSwaps): samples of counterfactuals.
        no_pictures (str): why a known simulator could not render; ``""`` if it could.

    Returns:
        list of Problem: errors first, then warnings.
    """
    messages = [finding.message for finding in check.findings]
    found = [
        *_findings(check),
        *(
            Problem("warning", text.rstrip("."))
            for text in warnings
            # What was said of the same finding is not said twice.
            if not any(message in text for message in messages)
        ),
        *_threshold_problems(entities),
    ]
    if swaps.no_donor:
        found.append(
            Problem(
                "note",
                f"In {swaps.no_donor:,} samples an entity could have been swapped, but "
                "no other sample of the batch could give it another state",
                remedy="give CAIACTransform a donor buffer (donors=rb)",
            )
        )
    if no_pictures:
        found.append(
            Problem(
                "note",
                "The examples are drawn, not rendered, because the simulator could "
                f"not render: {no_pictures}",
            )
        )
    order = ("error", "warning", "note")
    return sorted(found, key=lambda problem: order.index(problem.severity))


def _findings(check: DatasetReport) -> list[Problem]:
    return [
        Problem(
            "error" if finding.severity == "error" else "warning",
            finding.message,
            finding.effect,
            finding.remedy,
        )
        for finding in check.findings
    ]


def _threshold_problems(entities: Sequence[Entity]) -> list[Problem]:
    swappable = [entity for entity in entities if not entity.fixed]
    found = []
    for entity in swappable:
        if entity.confidence != UNCLEAR:
            continue
        found.append(
            Problem(
                "warning",
                f"No clear threshold was found for {entity.name}: {entity.reason}",
                "it is never swapped"
                if entity.shares.rows == 0
                else "it may be swapped while the agent moves it",
                "look at its scores below, and choose a threshold by hand",
            )
        )
    never = [e for e in swappable if e.shares.rows == 0 and e.confidence != UNCLEAR]
    found += [
        Problem(
            "warning",
            f"{e.name} is never swapped: its score is above the threshold in every "
            "transition",
            "no counterfactual changes it",
            "check whether it ever rests; if so, the threshold is too low",
        )
        for e in never
    ]
    always = [e for e in swappable if e.shares.rows == 1]
    expected = [e.name for e in always if e.confidence == NEVER_INFLUENCED]
    if expected:
        found.append(
            Problem(
                "note",
                f"{', '.join(expected)}: never influenced, so swaps are possible in "
                "every transition",
            )
        )
    others = [e.name for e in always if e.confidence != NEVER_INFLUENCED]
    if others:
        found.append(
            Problem(
                "warning",
                f"{', '.join(others)}: swaps are possible in every transition, because "
                "the score is never above the threshold",
                "if the agent does move one of them, counterfactuals are wrong",
                "look at their scores below",
            )
        )
    return found
