"""Studies: what couples with what, over whatever a designer can vary."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
