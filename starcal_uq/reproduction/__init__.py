"""Ye & Yang 2017 run again: their systems as baselines, their experiment, and what holds over seeds."""

from __future__ import annotations

from starcal_uq.reproduction.command import reproduce

__all__ = ["reproduce"]
