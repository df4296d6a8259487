"""From observations to a calibration: the fit, a simpler model where it needs one, and what may be
wrong.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
