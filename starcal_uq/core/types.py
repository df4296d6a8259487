"""Array types used in signatures; shapes and units are stated in the docstrings."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, get_args, get_origin

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    FloatArray: TypeAlias = NDArray[np.float64]
    IntArray: TypeAlias = NDArray[np.int64]
    BoolArray: TypeAlias = NDArray[np.bool_]
    StrArray: TypeAlias = NDArray[np.str_]
AnyDict: TypeAlias = dict[str, Any]
AnyMapping: TypeAlias = Mapping[str, Any]
PathLike: TypeAlias = str | os.PathLike[str]
# Called with how many are done, and of how many.
Progress: TypeAlias = Callable[[int, int], None]


_ELEMENTS = {
    "FloatArray": "float64",
    "IntArray": "int64",
    "BoolArray": "bool_",
    "StrArray": "str_",
}


def __getattr__(name: str) -> Any:
    """Types of arrays, for modules that compute; others, as the command line's help, do without
    NumPy.
    """
    if name not in _ELEMENTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import numpy as np
    from numpy import typing

    of_elements: Any = typing.NDArray
    return globals().setdefault(name, of_elements[getattr(np, _ELEMENTS[name])])


def floats(values: Any) -> FloatArray:
    """Numbers as an array of doubles, the same array where it is one."""
    import numpy as np

    return np.asarray(values, dtype=np.float64)


def unaliased(hint: Any) -> Any:
    """An annotation without the type statement by which NumPy 2.5 declares NDArray, where Python
    has one.
    """
    origin = get_origin(hint)
    return origin.__value__[get_args(hint)] if hasattr(origin, "__value__") else hint
