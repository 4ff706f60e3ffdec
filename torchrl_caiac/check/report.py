"""What a check of a dataset found."""

from __future__ import annotations

import textwrap
from dataclasses import asdict, dataclass
from typing import Any, Literal

from tensordict.utils import NestedKey

from torchrl_caiac._keys import jsonable

__all__ = ["DatasetError", "DatasetReport", "Finding", "Severity"]

Severity = Literal["error", "warning"]

_WIDTH = 80
_INDENT = " " * 9


class DatasetError(ValueError):
    """A dataset has errors that make counterfactuals or scores wrong.

    Args:
        report (DatasetReport): what was found.

    Attributes:
        report (DatasetReport): the same.

    Examples:
        >>> from torchrl_caiac.check import DatasetError, DatasetReport
        >>> DatasetError(DatasetReport((), 5, 5, 1)).report.num_transitions
        5
    """

    def __init__(self, report: DatasetReport) -> None:
        super().__init__(str(report))
        self.report = report

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.report,)


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or may be wrong, with a dataset.

    Args:
        code (str): the kind of the finding, such as ``"next_zero_at_ends"``.
        severity (str): ``"error"`` or ``"warning"``.
        message (str): what was found, and where.
        effect (str): what it does to counterfactuals.
        remedy (str): what to do.
        key (NestedKey, optional): the entry concerned. Defaults to ``None``.
        columns (tuple of str): the columns concerned. Defaults to ``()``.
        rows (tuple of int): the first rows concerned. Defaults to ``()``.
        count (int): the number of checked rows concerned. Defaults to 0.

    Examples:
        >>> from torchrl_caiac.check import Finding
        >>> finding = Finding("ids_missing", "error", "no ids", "none", "add ids")
        >>> finding.to_dict()["code"]
        'ids_missing'
    """

    code: str
    severity: Severity
    message: str
    effect: str
    remedy: str
    key: NestedKey | None = None
    columns: tuple[str, ...] = ()
    rows: tuple[int, ...] = ()
    count: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Returns the finding as JSON-compatible values.

        Returns:
            dict: one entry for each argument.
        """
        return {
            **asdict(self),
            "key": jsonable(self.key),
            "columns": list(self.columns),
            "rows": list(self.rows),
        }

    def __str__(self) -> str:
        first = f"{self.severity:<8} {self.code}"
        texts = [
            f"{self.message}.",
            f"Effect: {self.effect}.",
            f"To do: {self.remedy}.",
        ]
        if self.rows:
            more = self.count - len(self.rows)
            named = ", ".join(map(str, self.rows))
            texts.insert(1, f"Rows: {named}" + (f" and {more} more." if more else "."))
        wrapped = [
            textwrap.fill(
                text,
                _WIDTH,
                initial_indent=_INDENT,
                subsequent_indent=_INDENT,
                break_on_hyphens=False,
            )
            for text in texts
        ]
        return "\n".join([first, *wrapped])


@dataclass(frozen=True)
class DatasetReport:
    """What :func:`~torchrl_caiac.check.check_dataset` found.

    Args:
        findings (tuple of Finding): errors first.
        num_transitions (int): the number of transitions of the dataset.
        num_checked (int): the number of transitions that were checked.
        num_trajectories (int): the number of trajectories of the dataset; 0 if they
            are unknown.

    Examples:
        >>> from torchrl_caiac.check import DatasetReport
        >>> report = DatasetReport((), 1000, 200, 10)
        >>> report.ok
        True
        >>> print(report)
        checked 200 of 1000 transitions, 10 trajectories: 0 errors, 0 warnings
    """

    findings: tuple[Finding, ...]
    num_transitions: int
    num_checked: int
    num_trajectories: int

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings that make counterfactuals or scores wrong."""
        return tuple(f for f in self.findings if f.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """The findings that may describe what was intended."""
        return tuple(f for f in self.findings if f.severity == "warning")

    @property
    def ok(self) -> bool:
        """Whether there are no errors."""
        return not self.errors

    def to_dict(self) -> dict[str, Any]:
        """Returns the report as JSON-compatible values.

        Returns:
            dict: ``"ok"``, the numbers, and a list ``"findings"`` of dicts.
        """
        return {
            "ok": self.ok,
            "num_transitions": self.num_transitions,
            "num_checked": self.num_checked,
            "num_trajectories": self.num_trajectories,
            "findings": [finding.to_dict() for finding in self.findings],
        }

    def raise_if_errors(self) -> None:
        """Raises if the dataset has errors.

        Raises:
            DatasetError: there is at least one error.
        """
        if not self.ok:
            raise DatasetError(self)

    def __str__(self) -> str:
        head = (
            f"checked {self.num_checked} of {self.num_transitions} transitions, "
            f"{self.num_trajectories} trajectories: {_counted(self.errors, 'error')}, "
            f"{_counted(self.warnings, 'warning')}"
        )
        return "\n".join([textwrap.fill(head, _WIDTH), *map(str, self.findings)])


def _counted(findings: tuple[Finding, ...], noun: str) -> str:
    return f"{len(findings)} {noun}{'' if len(findings) == 1 else 's'}"
