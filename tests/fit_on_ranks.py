"""A process of a group that fits world models: for torchrun, in tests."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import distributed

from tests.test_fit import fit, make, world


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group("gloo")
    rank = distributed.get_rank()
    common = {"checkpoint_every": 10, "distributed": True, "check": False}
    for name, calls in (("whole", [40]), ("parts", [20, 40])):
        for steps in calls:
            model, file = make(), folder / f"{name}.zip"
            table = fit(
                model, world(), steps=steps, batch_size=16, checkpoint=file, **common
            )
        state = [dict(model.named_parameters()), dict(model.named_buffers())]
        torch.save([*state, table.to_dict()], folder / f"{name}-{rank}.pt")
    for name, seed, batch in (("data", rank, 16), ("settings", 0, 16 + rank)):
        try:
            fit(make(), world(seed=seed), batch_size=batch, **common)
        except RuntimeError as error:
            (folder / f"{name}-{rank}.txt").write_text(str(error))
    distributed.destroy_process_group()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
