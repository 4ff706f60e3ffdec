"""Which entities an action can influence: estimators, and their cached scores."""

from __future__ import annotations
