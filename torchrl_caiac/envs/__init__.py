"""Simulated environments and their scripted experts."""

from __future__ import annotations
