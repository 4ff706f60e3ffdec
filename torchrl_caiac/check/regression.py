"""Linear functions between columns of states."""

from __future__ import annotations

import torch

from torchrl_caiac.check.sample import Sample
from torchrl_caiac.check.state import States
from torchrl_caiac.entities import EntityLayout

__all__ = ["Regression"]

_MAX_COLUMNS = 512  # wider entries, such as images, are left out
_ROWS = 20_000  # rows of the regression
_EXPLAINED = 0.999  # of the variance, in trajectories that were held out
_LONG = 1_000  # rows from which the halves of a single trajectory do
_RIDGE = 1e-10


class Regression:
    """Linear functions of owned columns, judged on trajectories that are held out.

    A column that is constant in each trajectory is a linear function of any others, if
    there are few trajectories. Only held-out trajectories tell.
    """

    def __init__(
        self,
        x: torch.Tensor,
        chosen: torch.Tensor,
        half: torch.Tensor,
        is_fixed: list[bool],
    ) -> None:
        self.chosen, self.half = chosen, half
        self.x = x
        self.gram = x[half].T @ x[half]
        self.is_fixed = torch.tensor(is_fixed)
        # Columns that are functions of the others, at least in the rows of the fit.
        inverse = torch.linalg.inv(
            self.gram + _RIDGE * len(x) * torch.eye(len(self.gram)).double()
        )
        inflation = self.gram.diagonal() * inverse.diagonal()
        self.is_candidate = (1 - 1 / inflation > _EXPLAINED).tolist()

    @classmethod
    def of(
        cls, sample: Sample, states: States, layout: EntityLayout
    ) -> Regression | None:
        """Returns the regression, ``None`` if there are too few rows."""
        width = states.now.shape[1]
        if width > _MAX_COLUMNS or len(sample) < 4 * width + 40:
            return None
        stride = -(-len(sample) // _ROWS)
        chosen = torch.arange(0, len(sample), stride)
        piece = sample.piece[chosen].unique(return_inverse=True)[1]
        half = piece % 2 == 0
        if int(piece.max()) < 3:
            if len(chosen) < _LONG:
                return None
            half = torch.arange(len(chosen)) < len(chosen) // 2
        x = states.now[chosen].double()
        loc, scale = x[half].mean(0), x.std(0, correction=0)
        x = (x - loc) / torch.where(scale > 0, scale, 1.0)
        fixed = [name in layout.fixed for name in states.owners]
        return cls(x, chosen, half, fixed)

    def explained(self, y: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Returns the explained share of the variance of ``y`` ``[n, U]``, ``[U]``."""
        y = y.double()
        y = y - y[self.half].mean(0)
        total = y[~self.half].square().mean(0)
        if not bool(columns.any()):
            return torch.where(total > 0, 0.0, 1.0)
        x = self.x[:, columns]
        gram = self.gram[columns][:, columns].clone()
        gram.diagonal().add_(_RIDGE * len(x))
        weight = torch.linalg.solve(gram, x[self.half].T @ y[self.half])
        rest = (y[~self.half] - x[~self.half] @ weight).square().mean(0)
        return torch.where(total > 0, 1 - rest / total, 0.0)

    def follows(self, values: torch.Tensor) -> torch.Tensor:
        """Returns which columns ``[n, U]`` follow owned columns, bool ``[U]``."""
        return self._follows(values, torch.ones_like(self.is_fixed))

    def stale(self, values: torch.Tensor) -> torch.Tensor:
        """Returns which columns ``[n, U]`` follow swapped entities, bool ``[U]``."""
        return self.follows(values) & ~self._follows(values, self.is_fixed)

    def _follows(self, values: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        y = values[self.chosen]
        finite = y.isfinite().all(0)
        y = torch.where(finite, y, 0.0)
        return finite & (self.explained(y, columns) > _EXPLAINED)

    def is_mixed(self, column: int, owner: list[str]) -> bool:
        """Returns whether a column is a function of another entity's columns too."""
        own = torch.tensor([name == owner[column] for name in owner])
        others = torch.ones_like(own)
        own[column] = others[column] = False
        if not self.is_candidate[column] or bool(own.all()):
            return False
        y = self.x[:, column : column + 1]
        return bool(self.explained(y, others)[0] > _EXPLAINED) and bool(
            self.explained(y, own)[0] < 0.99
        )
