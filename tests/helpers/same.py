"""Results held against each other to the last bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """Equal, with arrays and records inside; NaN is NaN, a list may have become a tuple, and an array
    without numbers has no shape.
    """
    if isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray) and a.dtype == b.dtype, where
        assert a.size == b.size, where
        np.testing.assert_array_equal(a if a.size else b, b, where)
    elif dataclasses.is_dataclass(a):
        assert type(a) is type(b), where
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for number, (ours, theirs) in enumerate(zip(a, b, strict=True)):
            assert_same(ours, theirs, f"{where}[{number}]")
    elif isinstance(a, Mapping):
        assert list(a) == list(b), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key}]")
    else:
        assert a == b or (a != a and b != b), where
