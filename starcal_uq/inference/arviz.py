"""The only importer of ArviZ, whose containers differ: `InferenceData` in 0.23, `DataTree` in 1.x.

Its numbers are those of `maths.chains`, which loads in no time.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import warnings
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr


@lru_cache(maxsize=1)
def is_legacy() -> bool:
    """True for ArviZ below 1.0."""
    return int(importlib.metadata.version("arviz").split(".")[0]) < 1


@lru_cache(maxsize=1)
def _legacy() -> Any:
    with warnings.catch_warnings():
        # 0.23 announces 1.x once a day; nothing that a user of this package could act on.
        warnings.filterwarnings("ignore", message=r"\s*ArviZ is undergoing a major refactor", category=FutureWarning)
        return importlib.import_module("arviz")


def to_arviz(groups: Mapping[str, xr.Dataset]) -> Any:
    """Wrap datasets (chain, draw), by their names in ArviZ's schema, in the container of the installed ArviZ."""
    if is_legacy():
        return _legacy().InferenceData(**groups)
    import xarray as xr

    return xr.DataTree.from_dict(dict(groups))
