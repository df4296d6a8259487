"""Tables in memory, of pandas, polars, astropy or xarray, as plain columns with their units."""

from __future__ import annotations

from typing import Any

import numpy as np

from starcal_uq.core.tables import RawTable, arrow_columns
from starcal_uq.core.units import plain


def raw_table(table: Any) -> RawTable:
    """A table in memory as one that was read from a file.

    It is known by what it offers: columns by name and `meta` (astropy), `to_dataframe` (xarray), or
    columns of Arrow (pandas, polars and others).
    """
    units = {}
    if hasattr(table, "colnames"):
        meta, columns = dict(table.meta), {str(n): _values(table[n]) for n in table.colnames}
        units = {name: str(getattr(table[name], "unit", None) or "") for name in columns}
    else:
        import pyarrow as pa

        meta = dict(getattr(table, "attrs", {}))
        if hasattr(table, "to_dataframe"):
            units = {str(n): str(table[n].attrs.get("units", "")) for n in table.variables}
            table = table.to_dataframe().reset_index()
        columns = arrow_columns(pa.table(table))
        # The numbers of the rows of a pandas table that was filtered or sorted.
        columns = {n: values for n, values in columns.items() if not n.startswith("__index_level")}
    n_rows = len(next(iter(columns.values()), ()))
    return RawTable(columns, list(columns), np.arange(1, n_rows + 1), "row", meta, units)


def _values(column: Any) -> Any:
    """A column of astropy: an array of numbers without gaps, or texts."""
    if hasattr(column, "isot"):
        return np.atleast_1d(plain("time_utc", column)).tolist()
    held = getattr(column, "value", column)
    gaps, values = np.ma.getmaskarray(held), np.asarray(np.ma.getdata(held))
    if values.dtype.kind in "iuf" and not gaps.any():
        return values
    texts = np.char.decode(values) if values.dtype.kind == "S" else values
    return ["" if gap else str(value) for value, gap in zip(texts.tolist(), gaps, strict=True)]
