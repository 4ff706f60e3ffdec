"""Collecting, loading and storing demonstrations."""

from __future__ import annotations
