"""Causal action influence in plain Python, to test against."""

from __future__ import annotations

import math
from typing import Any


def plain_influence(loc: list[Any], var: list[Any], approximation: str) -> float:
    """Returns the influence by eq. 3; ``loc`` and ``var`` are lists ``[K][d]``."""
    k, d = len(loc), len(loc[0])
    total = 0.0
    for i in range(k):
        variational = product = own = 0.0
        for c in range(d):
            if approximation == "product":
                own += -0.5 * math.log(2 * math.pi * 2 * var[i][c])
            else:
                own += -0.5 * math.log(2 * math.pi * math.e * var[i][c])
        for j in range(k):
            kl = log_product = 0.0
            for c in range(d):
                m, n, v, w = loc[i][c], loc[j][c], var[i][c], var[j][c]
                kl += 0.5 * (math.log(w / v) + (v + (m - n) ** 2) / w - 1)
                log_product -= 0.5 * math.log(2 * math.pi * (v + w))
                log_product -= 0.5 * (m - n) ** 2 / (v + w)
            variational += math.exp(-kl) / k
            product += math.exp(log_product - own) / k
        total += max(0.0, -math.log(variational)) / 2
        total += max(0.0, -math.log(product) if product else math.inf) / 2
    return total / k
