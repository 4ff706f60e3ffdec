"""Losses, and the fitting of world models."""

from __future__ import annotations
