"""Both generations of ArviZ give the same answers through the compatibility module."""

from __future__ import annotations

import numpy as np
import xarray as xr

from starcal_uq.inference import arviz as arviz_compat


def test_container_holds_the_groups() -> None:
    dataset = xr.Dataset({"f": (("chain", "draw"), np.zeros((2, 3)), {"units": "px"})}, attrs={"made_by": "test"})
    data = arviz_compat.to_arviz({"posterior": dataset})
    import arviz

    # By its own version, not by what the module under test says.
    assert type(data) is (arviz.InferenceData if arviz.__version__.startswith("0.") else xr.DataTree)
    assert data.posterior["f"].shape == (2, 3)
    assert data.posterior["f"].attrs["units"] == "px"
    assert data.posterior.attrs["made_by"] == "test"
