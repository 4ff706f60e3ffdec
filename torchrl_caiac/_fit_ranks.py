"""Processes that fit one model together, see :mod:`torch.distributed`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import distributed, nn

from torchrl_caiac._files import plain
from torchrl_caiac.modules.running_norm import RunningNorm

__all__ = ["Ranks"]


class Ranks:
    """The processes of the default group, or this process alone.

    Args:
        several (bool): whether there are several.

    Raises:
        RuntimeError: there is no process group.
    """

    def __init__(self, several: bool) -> None:
        self.rank, self.world = 0, 1
        if not several:
            return
        if not (distributed.is_available() and distributed.is_initialized()):
            raise RuntimeError(
                "distributed=True, but this process is in no process group: call "
                "torch.distributed.init_process_group first, and start the processes "
                "with torchrun"
            )
        self.rank, self.world = distributed.get_rank(), distributed.get_world_size()

    @property
    def device(self) -> torch.device:
        """The device of what the processes exchange."""
        is_nccl = self.world > 1 and "nccl" in str(distributed.get_backend())
        return torch.device("cuda" if is_nccl else "cpu")

    def check_same(self, settings: Mapping[str, Any], step: int) -> None:
        """Raises in all processes if they differ in settings, or in steps so far."""
        if self.world == 1:
            return
        for what, value in (("settings or data", settings), ("step", step)):
            text = json.dumps(plain(value), sort_keys=True, default=str)
            digest = list(hashlib.sha256(text.encode()).digest())
            mine = torch.tensor(digest, dtype=torch.uint8, device=self.device)
            found = [torch.empty_like(mine) for _ in range(self.world)]
            distributed.all_gather(found, mine)
            other = [
                i for i in range(self.world) if not torch.equal(found[i], found[0])
            ]
            if other:
                raise RuntimeError(
                    f"distributed=True: the processes of rank {other} have other "
                    f"{what} than that of rank 0 (here: {text[:500]}): call "
                    "fit_world_model with the same arguments in all, and give a "
                    "checkpoint in a file system that they share"
                )

    @torch.no_grad()
    def copy_state(self, model: nn.Module) -> None:
        """Copies the weights and statistics of the first process to all others."""
        if self.world > 1:
            for tensor in (*model.parameters(), *model.buffers()):
                self._exchange(tensor, lambda t: distributed.broadcast(t, 0))

    def average_gradients(self, model: nn.Module) -> None:
        """Averages the gradients over the processes, all of them in one message."""
        if self.world > 1:
            self._average([p.grad for p in model.parameters() if p.grad is not None])

    def average_statistics(self, model: nn.Module) -> None:
        """Averages the running statistics, which each process has of its batches."""
        if self.world > 1:
            norms = [m for m in model.modules() if isinstance(m, RunningNorm)]
            self._average([x for n in norms for x in (n.count, n.mean, n.m2)])
            for norm in norms:
                norm.replace(norm)  # what follows from the statistics

    def average(self, tensor: torch.Tensor) -> None:
        """Averages a tensor over the processes, in place."""
        if self.world > 1:
            self._average([tensor])

    def by_the_first(self, act: Callable[..., Any], *args: Any) -> None:
        """Has the first process do something, while the others wait.

        Raises:
            RuntimeError: it failed, in the other processes.
        """
        error: BaseException | None = None
        if self.rank == 0:
            try:
                act(*args)
            except Exception as caught:
                error = caught
        if self.world > 1:
            failed = torch.tensor(float(error is not None), device=self.device)
            distributed.all_reduce(failed)
            if failed and error is None:
                raise RuntimeError("the process of rank 0 failed: see its error")
        if error is not None:
            raise error

    def _average(self, tensors: list[torch.Tensor]) -> None:
        by_dtype: dict[torch.dtype, list[torch.Tensor]] = {}
        for tensor in tensors:
            by_dtype.setdefault(tensor.dtype, []).append(tensor)
        for group in by_dtype.values():
            flat = torch.cat([t.reshape(-1) for t in group]).to(self.device)
            distributed.all_reduce(flat)
            flat /= self.world
            parts = flat.split([t.numel() for t in group])
            for tensor, part in zip(group, parts, strict=True):
                tensor.copy_(part.view_as(tensor))

    def _exchange(self, tensor: torch.Tensor, act: Callable[[Any], Any]) -> None:
        moved = tensor.to(self.device).contiguous()
        act(moved)
        tensor.copy_(moved)
