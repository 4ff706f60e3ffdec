"""Replay-buffer transforms that make counterfactual samples."""

from __future__ import annotations
