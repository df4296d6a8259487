"""A column of texts of which few differ, such as the names of stars in many frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import ArrayLike, NDArray

from starcal_uq.core.types import StrArray

# Whoever takes an array of texts takes these as well.
_ARRAY: Any = NDArrayOperatorsMixin


class Texts(_ARRAY):  # type: ignore[misc]
    """Texts (N,) as whole numbers, the places of a few different ones: a view that is used as an
    array of texts.

    NumPy's functions take it as an array; methods of arrays that are not here work on a copy in
    text. It cannot be written to.

    Attributes
    ----------
    codes : array of int32, shape (N,)
        Place of each text in `names`; in their order, so that codes compare as the texts do.
    names : array of str, shape (D,)
        The different texts, ascending.
    """

    codes: NDArray[np.int32]
    names: StrArray
    ndim = 1

    def __init__(self, codes: NDArray[np.int32], names: StrArray) -> None:
        for values in (codes, names):
            values.setflags(write=False)
        self.codes, self.names = codes, names
        self.dtype, self.shape = names.dtype, codes.shape

    @classmethod
    def of(cls, values: Any) -> Texts:
        """Texts of a sequence; a missing one, None or NaN in an array of objects, is empty."""
        if isinstance(values, Texts):
            return values
        array = np.asarray(values)
        if array.dtype.kind == "O":
            # pandas marks a missing text by None or NaN, which would become words.
            cells = ["" if v is None or v != v else str(v) for v in array.tolist()]
        else:
            cells = array.astype(np.str_, copy=False).tolist()
        places = {text: place for place, text in enumerate(dict.fromkeys(cells))}
        return cls.placed(np.fromiter(map(places.__getitem__, cells), np.int64), list(places))

    @classmethod
    def placed(cls, place: ArrayLike, texts: Sequence[str] | StrArray) -> Texts:
        """Texts by their places (N,) in a list, in which some may be alike or unused."""
        place, listed = np.asarray(place, dtype=np.int64), np.asarray(texts, dtype=np.str_)
        used = np.flatnonzero(np.bincount(place, minlength=len(listed)))
        names, rank = np.unique(listed[used], return_inverse=True)
        codes = np.empty(len(listed), dtype=np.int32)
        codes[used] = rank
        return cls(codes[place], names)

    @classmethod
    def unknown(cls, n: int) -> Texts:
        """A column of n empty texts."""
        return cls.placed(np.zeros(n), [""])

    @classmethod
    def joined(cls, parts: Sequence[Texts]) -> Texts:
        """Several columns, one after the other."""
        names = np.unique(np.concatenate([part.names for part in parts]))
        places = [np.searchsorted(names, part.names)[part.codes] for part in parts]
        return cls(np.concatenate(places).astype(np.int32), names)

    def map(self, function: Callable[[str], str]) -> Texts:
        """The column with each text replaced by what a function makes of it."""
        return Texts.placed(self.codes, list(map(function, self.names.tolist())))

    def tolist(self) -> list[str]:
        """The texts; equal ones are one object."""
        return self.names.astype(object)[self.codes].tolist()  # type: ignore[no-any-return]

    def setflags(self, **flags: Any) -> None:
        """Nothing to do: it cannot be written to."""

    def __len__(self) -> int:
        return len(self.codes)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.tolist())

    def __getitem__(self, rows: Any) -> Any:
        codes = self.codes[rows]
        return Texts.placed(codes, self.names) if codes.ndim else self.names[codes]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.asarray(self.names[self.codes], dtype=dtype)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        others = [one for one in inputs if one is not self]
        if method == "__call__" and not any(map(np.ndim, others)):
            # What is true of a text is true wherever it stands.
            inputs = tuple(self.names if one is self else one for one in inputs)
            return ufunc(*inputs, **kwargs)[self.codes]
        return getattr(ufunc, method)(*map(np.asarray, inputs), **kwargs)

    def __getattr__(self, name: str) -> Any:
        # NumPy looks for special names, which must not be those of a copy that is gone.
        if name.startswith("_") or not hasattr(np.ndarray, name):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)

    def __repr__(self) -> str:
        return repr(np.asarray(self))
