"""Ye & Yang 2017 run again: their systems, their experiment, and what holds over seeds."""

from collections.abc import Mapping

import lazy_loader

from starcal_uq.core.display import View, register

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _views() -> Mapping[type, View]:
    from starcal_uq.paper.show.views import VIEWS

    return VIEWS


register(_views)
