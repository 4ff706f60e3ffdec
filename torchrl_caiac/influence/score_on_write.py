"""Scores transitions when they are written into a replay buffer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_caiac._buffer_transform import BufferTransform
from torchrl_caiac._checks import check_int
from torchrl_caiac._fingerprints import fingerprint, fingerprint_key, state_hash
from torchrl_caiac._keys import as_key, missing_key
from torchrl_caiac.influence.cai import CAI
from torchrl_caiac.influence.estimator_digest import DigestCache
from torchrl_caiac.influence.score_record import score_settings, settings_digest
from torchrl_caiac.influence.scorer import (
    layout_of,
    reads_state_only,
    to_device_of,
)
from torchrl_caiac.trajectories import STEPS_KEY

__all__ = ["ScoreOnWrite"]


class ScoreOnWrite(BufferTransform):
    r"""Computes the influence scores of all transitions that are written to a buffer.

    Append it to an empty buffer, for example one that collectors write to. With
    ``lookahead=1``, a transition gets the larger one of the scores of its state and its
    next state; with ``lookahead=0``, that of its state. These are the scores of
    :func:`~torchrl_caiac.influence.score_buffer` without smoothing, which keeps
    them if it is called with the same settings. Transitions are scored in batches, as
    they are written. Samples pass unchanged.

    The estimator is no submodule: the state of the buffer does not contain its weights.
    If they change, later transitions are scored with the new ones. A change is noticed
    by torch's count of writes, which leaves out those to ``parameter.data``.

    Args:
        estimator (callable): see :func:`~torchrl_caiac.influence.score_buffer`.

    Keyword Args:
        key (NestedKey): the score leaf. Defaults to ``("caiac", "score")``.
        lookahead (int): 0 or 1, see above. Defaults to 1. It must be 0 for an estimator
            that reads more than the state.
        batch_size (int): the number of states scored at once, at least 1. Defaults to
            4096.
        trajectory_key (NestedKey, optional): as in ``score_buffer``. Scores do not
            depend on it, but settings do. Defaults to ``"episode"``.
        done_key (NestedKey, optional): the same. Defaults to ``("next", "done")``.

    Raises:
        TypeError: the estimator has no layout.
        ValueError: an argument is out of range; the estimator is a
            :class:`~torchrl_caiac.influence.CAI` in the fast mode that has scored
            nothing yet; transitions have next states that are several steps later; an
            observation or a score is not finite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_caiac import EntityLayout
        >>> from torchrl_caiac.influence import ScoreOnWrite
        >>> class Height:
        ...     layout = EntityLayout({"arm": [0], "cup": [1]})
        ...     def __call__(self, td):
        ...         return td["observation"]
        >>> rb = ReplayBuffer(
        ...     storage=LazyTensorStorage(10), transform=ScoreOnWrite(Height())
        ... )
        >>> _ = rb.extend(
        ...     TensorDict(
        ...         {
        ...             "observation": torch.tensor([[0.0, 5.0], [1.0, 4.0]]),
        ...             "next": {"observation": torch.tensor([[1.0, 4.0], [2.0, 3.0]])},
        ...         },
        ...         [2],
        ...     )
        ... )
        >>> rb[:]["caiac", "score"]
        tensor([[1., 5.],
                [2., 4.]])
    """

    def __init__(
        self,
        estimator: Callable[[TensorDictBase], torch.Tensor],
        *,
        key: NestedKey = ("caiac", "score"),
        lookahead: Literal[0, 1] = 1,
        batch_size: int = 4096,
        trajectory_key: NestedKey | None = "episode",
        done_key: NestedKey | None = ("next", "done"),
    ) -> None:
        super().__init__()
        if lookahead not in (0, 1) or isinstance(lookahead, bool):
            raise ValueError(
                f"lookahead must be 0 or 1, got {lookahead!r}: later transitions are "
                "not known yet. Use score_buffer for more"
            )
        check_int("batch_size", batch_size, 1)
        if isinstance(estimator, CAI) and not estimator.is_ready:
            raise ValueError(
                "the estimator is a CAI in the fast mode that has scored nothing yet, "
                "so the first transitions written would decide which scores are exact: "
                "use mode='exact', or score a buffer with it first"
            )
        self.layout = layout_of(estimator)
        if lookahead and not reads_state_only(estimator, self.layout):
            raise ValueError(
                "the estimator reads more than the state, which next states lack: use "
                "lookahead=0"
            )
        # In a tuple, so that torch does not register the estimator as a submodule.
        self._estimator = (estimator,)
        self._digests = DigestCache()
        self.key = as_key(key)
        self.lookahead = lookahead
        self.batch_size = batch_size
        self.trajectory_key = trajectory_key
        self.done_key = done_key
        self.in_keys_inv = [
            *self.layout.in_keys,
            *(self.layout.next(key) for key in self.layout.in_keys),
        ]
        self.out_keys_inv = [self.key, fingerprint_key(self.key)]

    @property
    def estimator(self) -> Callable[[TensorDictBase], torch.Tensor]:
        """The estimator."""
        return self._estimator[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a sample unchanged.

        Args:
            tensordict (TensorDictBase): the sample.

        Returns:
            TensorDictBase: the same sample.
        """
        return tensordict

    @torch.no_grad()
    def _inv_call(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        if tensordict is None:  # a transform before this one waits for more rows
            return None
        steps = tensordict.get(STEPS_KEY, None)
        if steps is not None and bool((steps > 1).any()):
            raise ValueError(
                f"the next states are several steps later, see {STEPS_KEY!r}, and the "
                "states in between are not known here: use score_buffer with a "
                "lookahead of this many steps"
            )
        shape, layout = tensordict.batch_size, self.layout
        flat = tensordict.reshape(-1)
        after = flat.get(layout.next_key, None)
        if after is None:
            raise missing_key(
                flat,
                layout.next_key,
                "the transitions lack the next state",
                "write whole transitions",
            )
        scores = self._scores(flat)
        if self.lookahead:
            scores = torch.maximum(scores, self._scores(after))
        finite = scores.isfinite().flatten(1).all(1)
        if not bool(finite.all()):
            raise ValueError(
                "the estimator returned NaN or infinite scores for the transitions "
                f"{(~finite).nonzero()[:8, 0].tolist()} that are written: check their "
                "observations, and the model"
            )
        settings = score_settings(
            self._digests.digest(self.estimator),
            layout,
            smoothing=1,
            lookahead=self.lookahead,
            every=1,
            trajectory_key=self.trajectory_key,
            done_key=self.done_key,
        )
        state = state_hash(flat, layout.in_keys)
        assert state is not None  # the estimator read it
        known = fingerprint(
            state,
            state_hash(flat, [layout.next(key) for key in layout.in_keys]),
            layout.names,
            settings_digest(settings),
        )
        out = tensordict.copy()
        out.set(self.key, scores.view(*shape, *scores.shape[1:]).to(known.device))
        out.set(fingerprint_key(self.key), known.view(shape))
        return out

    def _scores(self, states: TensorDictBase) -> torch.Tensor:
        parts: list[torch.Tensor] = []
        for part in states.split(self.batch_size):
            found = self.estimator(to_device_of(self.estimator, part.clone()))
            n = len(self.layout)
            if tuple(found.shape[1:]) not in ((n,), (n + 1, n)):
                raise ValueError(
                    f"the estimator returned the shape {list(found.shape)} for "
                    f"{len(part)} states, expected {[len(part), n]} or "
                    f"{[len(part), n + 1, n]}"
                )
            parts.append(found.detach().float())
        return torch.cat(parts)

    def extra_repr(self) -> str:
        """Returns the settings, for ``repr``."""
        return f"key={self.key!r}, lookahead={self.lookahead}"
