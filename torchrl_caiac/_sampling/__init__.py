"""What sampling does to each row, in C or CUDA: compiled where it runs.

Each function gives the numbers of its reference, which computes them by operations of
torch, to the bit. Without a compiler the reference is used. The functions are in
``sampling.c``, for tensors on the CPU, and in ``sampling.cu``.
"""

from torchrl_caiac._sampling.draws import (
    batch_donors,
    buffer_donors,
    chosen_windows,
)
from torchrl_caiac._sampling.goals import (
    hindsight_sources,
    relabel_batch,
    relabel_rows,
    window_goals,
)
from torchrl_caiac._sampling.native import is_native, only_torch, plain
from torchrl_caiac._sampling.on_cuda import LEAVES as MOST_LEAVES
from torchrl_caiac._sampling.rows import (
    all_finite,
    batch_fits,
    free_windows,
    gather_rows,
    look,
    read_ahead,
    read_columns,
    row_sums,
    rows_equal,
    rows_fit,
    state_matches,
)
from torchrl_caiac._sampling.runs import Runs
from torchrl_caiac._sampling.swaps import DonorRows, SwappedBatch, swap_batch, swap_rows

__all__ = [
    "MOST_LEAVES",
    "DonorRows",
    "Runs",
    "SwappedBatch",
    "all_finite",
    "batch_donors",
    "batch_fits",
    "buffer_donors",
    "chosen_windows",
    "free_windows",
    "gather_rows",
    "hindsight_sources",
    "is_native",
    "look",
    "only_torch",
    "plain",
    "read_ahead",
    "read_columns",
    "relabel_batch",
    "relabel_rows",
    "row_sums",
    "rows_equal",
    "rows_fit",
    "state_matches",
    "swap_batch",
    "swap_rows",
    "window_goals",
]
