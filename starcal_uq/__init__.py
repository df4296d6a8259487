"""Probabilistic calibration of star sensors: from identified stars to a posterior and its attitude
error.

The names of the daily work are here, all others in the wings, which are namespaces:
``sc.simulation.render``, ``sc.planning.choose_frames``. Nothing is loaded before it is used. What
this package offers stands, with its types, in ``__init__.pyi`` beside this file, and so it does in
every wing.
"""

from collections.abc import Callable, Mapping
from typing import Any

import lazy_loader

from starcal_uq.core.display import View, register
from starcal_uq.core.findings import Finding, register_wording
from starcal_uq.core.remedy import Remedy, register_commands

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _views() -> Mapping[type, View]:
    from starcal_uq.presentation.views import VIEWS

    return VIEWS


register(_views)


def _commands() -> Callable[[Remedy], str]:
    from starcal_uq.cli.remedies import command

    return command


register_commands(_commands)


def _wording() -> Callable[[Finding], Any]:
    from starcal_uq.presentation.words.sentences import wording

    return wording


register_wording(_wording)
