"""Former place of `starcal_uq.wahba`: as a module of this name it would hide the function ``starcal_uq.quest``."""

from __future__ import annotations

from starcal_uq.wahba import DegenerateFrameError, QuestResult, quest

__all__ = ["DegenerateFrameError", "QuestResult", "quest"]
