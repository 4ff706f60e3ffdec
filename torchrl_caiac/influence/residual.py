"""Influence from the recorded motion that an entity's own state does not explain."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import ReplayBuffer
from torchrl.modules import MLP
from tqdm.auto import tqdm
from typing_extensions import Self

from torchrl_caiac._keys import floating
from torchrl_caiac._layout_units import position_features
from torchrl_caiac.entities import EntityLayout
from torchrl_caiac.influence.distance import checked_agent
from torchrl_caiac.influence.motion import MotionInfluence, Tolerance
from torchrl_caiac.noise import sample_rows

__all__ = ["ResidualInfluence"]

_logger = logging.getLogger("torchrl_caiac.influence.residual")


class _EntityAlone(nn.Module):
    """Predicts how the positions of one entity change, from its own state.

    Args:
        features (list of int): the entity's features in the state.
        outputs (int): the number of its position columns.
        hidden_sizes (sequence of int): the widths of the hidden layers.
    """

    def __init__(
        self, features: list[int], outputs: int, hidden_sizes: Sequence[int]
    ) -> None:
        super().__init__()
        self.net = MLP(
            in_features=len(features),
            out_features=outputs,
            num_cells=list(hidden_sizes),
            activation_class=nn.SiLU,
        )
        # The prediction is "nothing moves" before the fit.
        nn.init.zeros_(self.net[-1].weight)
        nn.init.zeros_(self.net[-1].bias)
        self.features: torch.Tensor
        self.loc: torch.Tensor
        self.scale: torch.Tensor
        self.unit: torch.Tensor
        self.register_buffer("features", torch.tensor(features))
        self.register_buffer("loc", torch.zeros(len(features)))
        self.register_buffer("scale", torch.ones(len(features)))
        self.register_buffer("unit", torch.ones(outputs))

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        own = state[..., self.features].to(self.loc.dtype)
        return self.unit * self.net((own - self.loc) / self.scale)


class ResidualInfluence(MotionInfluence):
    r"""Counts an entity as influenced if its own state does not explain its motion.

    It generalises :class:`MotionInfluence` to entities that move by themselves, such as
    a ball that rolls on. A small network for each entity predicts the change of its
    positions, :math:`f_j(s_j)`, from its own state alone. An entity has the score

    .. math:: d = \max_c |s'_c - s_c - f_{j,c}(s_j)| / \tau_c

    over its position columns :math:`c` if :math:`d > 1`, and 0 if not. This is a
    pointwise form of transfer entropy, :math:`\log p(s'_j | s, a) - \log p(s'_j |
    s_j)`, with a constant as the first term, and a Cauchy density with the scale
    :math:`\tau` as the second.

    The networks maximise the likelihood of that density. It is heavy-tailed, so
    transitions that the entity's state does not explain hardly change the fit, unless
    most transitions from that state are of this kind. The network then learns them as
    the entity's own motion. Therefore,

    - the state needs velocities: without them, rolling looks the same as being pushed;
    - demonstrations that always move an entity in the same way from the same place
      look like its own motion. Pass ``far``, if the layout has positions in the same
      frame: the networks are then fitted to transitions in which the agent is at least
      that far away.

    Use :class:`MotionInfluence` for entities that rest unless they are moved.

    Args:
        layout (EntityLayout): the entities.
        tolerance (float, mapping or str): the largest residual of a column that does
            not count as influence; see :class:`MotionInfluence`. Defaults to
            ``"auto"``.

    Keyword Args:
        hidden_sizes (sequence of int): the widths of the networks' hidden layers.
            Defaults to ``(64, 64)``.
        agent (str, optional): the entity whose distance ``far`` is about. Defaults to
            the layout's only ``fixed`` one.
        far (float, optional): the networks are fitted to transitions in which the
            agent is at least this far from the entity, in the units of the positions.
            Defaults to ``None``: all transitions.

    Raises:
        TypeError: a tolerance is not a number.
        ValueError: an entity has no tolerance, or one that is not positive; ``far`` is
            not positive; the positions of the agent and an entity cannot be compared.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import MotionInfluence, ResidualInfluence
        >>> state = torch.rand(1000, 2)  # the position and the velocity of a ball
        >>> after = state + torch.stack([state[:, 1], torch.zeros(1000)], 1)
        >>> after[::10, 0] += 0.5  # kicked
        >>> td = TensorDict(
        ...     {"observation": state, ("next", "observation"): after}, [1000]
        ... )
        >>> layout = EntityLayout({"ball": [0, 1]}, positions={"ball": [0]})
        >>> moves = MotionInfluence(layout, 0.1)(td) > 0
        >>> ball = ResidualInfluence(layout, 0.1).fit(td, progress=False)
        >>> moves.float().mean() > 0.8, (ball(td) > 0).float().mean()
        (tensor(True), tensor(0.1000))
    """

    def __init__(
        self,
        layout: EntityLayout,
        tolerance: Tolerance | Literal["auto"] = "auto",
        *,
        hidden_sizes: Sequence[int] = (64, 64),
        agent: str | None = None,
        far: float | None = None,
    ) -> None:
        super().__init__(layout, tolerance)
        self.hidden_sizes = tuple(hidden_sizes)
        self.far = far
        self.agent = agent
        if far is not None:
            if not 0 < far < math.inf:
                raise ValueError(f"far must be positive and finite, got {far!r}")
            self.agent = _far_agent(layout, agent)
        self.entities: nn.ModuleList | None = None

    @property
    def fitted(self) -> bool:
        """Whether the tolerances and the networks are known."""
        return super().fitted and self.entities is not None

    def fit(
        self,
        data: TensorDictBase | ReplayBuffer,
        *,
        steps: int = 2_000,
        batch_size: int = 1_024,
        lr: float = 3e-3,
        max_rows: int = 200_000,
        seed: int = 0,
        progress: bool = True,
    ) -> Self:
        """Measures the tolerances and fits the networks, in seconds.

        The log says how much of the motion of each entity it explains alone. Equal
        seeds give equal networks.

        Args:
            data (TensorDictBase or ReplayBuffer): transitions, ``[*B]``.

        Keyword Args:
            steps (int): the number of gradient steps. Defaults to 2,000.
            batch_size (int): the number of rows in a step. Defaults to 1,024.
            lr (float): the learning rate of Adam, which decays to 0 along a cosine.
                Defaults to 3e-3.
            max_rows (int): the number of rows to read, evenly spaced. Defaults to
                200,000.
            seed (int): the seed of the networks and of the batches. Defaults to 0.
            progress (bool): whether to show a progress bar. Defaults to ``True``.

        Returns:
            ResidualInfluence: this estimator.

        Raises:
            KeyError: the state or the next state is missing.
            ValueError: there are no rows; the states have NaN or infinite values; an
                entity has no row in which the agent is far.
        """
        if steps < 1 or batch_size < 1:
            raise ValueError(
                f"steps and batch_size must be at least 1, got {steps} and {batch_size}"
            )
        super().fit(data)
        rows = sample_rows(data, max_rows)
        self.layout.check(rows, next=True)
        # Scores the rows as motion, which also checks that they are finite.
        self.entities = None
        moved = self._motion(rows)
        stored = self.layout.read(rows)
        state = stored.cpu().flatten(0, -2)
        after = self.layout.read(rows, next=True).cpu().flatten(0, -2)
        # Before they become float32, so that small changes far from zero are kept.
        changes = (floating(after) - floating(state)).float()
        state = state.float()
        index, limit, owner = self.columns(state, rows)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            entities = nn.ModuleList()
            bar = tqdm(
                self.layout.slices(rows).items(),
                desc="fitting each entity alone",
                unit="entity",
                disable=not progress,
            )
            for number, (name, where) in enumerate(bar):
                own = owner == number
                entity = _EntityAlone(
                    list(range(where.start, where.stop)),
                    int(own.sum()),
                    self.hidden_sizes,
                )
                change = changes[:, index[own]]
                use = self._usable(state, name, rows)
                _fit(
                    entity,
                    state[use],
                    change[use],
                    limit[own].float(),
                    steps=steps,
                    batch_size=batch_size,
                    lr=lr,
                )
                entities.append(entity)
        self.entities = entities.to(stored.device).eval().requires_grad_(False)
        self._log_explained(moved > 0, self(rows).flatten(0, -2) > 0)
        return self

    def _log_explained(self, moved: torch.Tensor, influenced: torch.Tensor) -> None:
        """Logs how much of the motion, bool ``[n, N]``, is not influence."""
        for number, name in enumerate(self.layout.names):
            moves = moved[:, number]
            own = moves & ~influenced[:, number]
            _logger.info(
                "%r moves in %.1f %% of %d rows, of which its own state explains "
                "%.1f %%",
                name,
                100 * float(moves.float().mean()),
                len(moves),
                100 * float(own.sum() / moves.sum().clamp_min(1)),
            )

    def expected_change(self, state: torch.Tensor) -> torch.Tensor | float:
        """Returns what the networks predict.

        Args:
            state (torch.Tensor): the features of all entities, ``[*B, W]``.

        Returns:
            torch.Tensor: ``[*B, P]``, the position columns of all entities in layout
            order.

        Raises:
            RuntimeError: the networks are not fitted.
        """
        if self.entities is None:
            raise RuntimeError(
                "the networks of ResidualInfluence are not fitted: call fit(data) first"
            )
        return torch.cat([entity(state) for entity in self.entities], -1)

    @torch.no_grad()
    def _motion(self, rows: TensorDictBase) -> torch.Tensor:
        assert self.tolerance is not None
        return MotionInfluence(self.layout, self.tolerance)(rows).flatten(0, -2)

    def _usable(
        self, state: torch.Tensor, name: str, rows: TensorDictBase
    ) -> torch.Tensor:
        """Returns the rows that the network of an entity is fitted to, bool ``[n]``."""
        if self.far is None or name == self.agent:
            return torch.ones(len(state), dtype=torch.bool)
        assert self.agent is not None
        places = []
        for entity in (self.agent, name):
            where = self.layout.slices(rows)[entity]
            own = position_features(self.layout, entity, where.stop - where.start)
            places.append(state[:, [where.start + feature for feature in own]])
        use = (places[0] - places[1]).norm(dim=-1) >= self.far
        if not bool(use.any()):
            raise ValueError(
                f"{self.agent!r} is never at least {self.far} away from {name!r}: pass "
                "a smaller far"
            )
        return use

    def extra_repr(self) -> str:
        """Returns the settings, for ``repr``."""
        return (
            f"{super().extra_repr()}, hidden_sizes={self.hidden_sizes}, "
            f"agent={self.agent!r}, far={self.far}"
        )


def _far_agent(layout: EntityLayout, agent: str | None) -> str:
    """Returns the agent, if its distance from the other entities is known."""
    agent = checked_agent(layout, agent)
    sizes = {name: len(layout.positions.get(name, ())) for name in layout.names}
    if len(set(sizes.values())) != 1 or not sizes[agent]:
        raise ValueError(
            f"far needs positions with the same coordinates for all entities, but they "
            f"have {sizes} columns: give EntityLayout(..., positions=), or leave out "
            "far"
        )
    return agent


def _fit(
    entity: _EntityAlone,
    state: torch.Tensor,
    change: torch.Tensor,
    limit: torch.Tensor,
    *,
    steps: int,
    batch_size: int,
    lr: float,
) -> None:
    """Maximises a Cauchy likelihood with the scale of the tolerance."""
    own = state[:, entity.features]
    entity.loc.copy_(own.mean(0))
    deviation = own.std(0, unbiased=False)
    entity.scale.copy_(torch.where(deviation > 0, deviation, 1))
    entity.unit.copy_(torch.maximum(change.square().mean(0).sqrt(), limit))
    optimizer = torch.optim.Adam(entity.parameters(), lr=lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        batch = torch.randint(len(state), (batch_size,))
        residual = (change[batch] - entity(state[batch])) / limit
        loss = residual.square().log1p().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
