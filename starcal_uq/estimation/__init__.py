"""A fit: stages, refinement, the estimate with its covariance, and what adds such fits up."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
