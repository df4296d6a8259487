"""Ye & Yang 2017 run again: their systems, their experiment, and what holds over seeds."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
