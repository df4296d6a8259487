"""The container of draws is that of the installed generation of ArviZ."""

from __future__ import annotations

import numpy as np
import xarray as xr

from starcal_uq.inference import arviz as arviz_compat


def test_container_holds_the_groups() -> None:
    dataset = xr.Dataset({"f": (("chain", "draw"), np.zeros((2, 3)), {"units": "px"})}, attrs={"made_by": "test"})
    data = arviz_compat.to_arviz({"posterior": dataset})
    assert type(data).__name__ == ("InferenceData" if arviz_compat.is_legacy() else "DataTree")
    assert data.posterior["f"].shape == (2, 3)
    assert data.posterior["f"].attrs["units"] == "px"
    assert data.posterior.attrs["made_by"] == "test"
