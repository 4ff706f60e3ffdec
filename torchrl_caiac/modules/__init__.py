"""World models and Latent Motor Plans as tensordict modules."""

from __future__ import annotations
