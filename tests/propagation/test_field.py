"""Direction uncertainty over the detector, against draws and rotations fitted one by one."""

import dataclasses
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from starcal_uq.core.errors import DistortionError
from starcal_uq.propagation.field import FieldMap, field_map
from tests.helpers.gaussian_camera import COVARIANCE
from tests.helpers.scenes import camera, observations


def posterior(covariance: np.ndarray = COVARIANCE, **changes: object) -> SimpleNamespace:
    cam = camera("brown", **changes)
    return SimpleNamespace(camera=cam, calibrated_camera=cam, mean=cam.theta, covariance=covariance)


@lru_cache
def paper_map() -> FieldMap:
    return field_map(posterior(), observations())


def test_what_cannot_be_mapped_is_said() -> None:
    with pytest.raises(ValueError, match="at least 2 grid points"):
        field_map(posterior(), observations(), n=1)
    folded = posterior()
    folded.calibrated_camera = folded.camera.with_theta(folded.mean * np.array([1, 1, 1, -1e4, 1]))
    with pytest.raises(DistortionError):
        field_map(folded, observations())


def test_files_of_earlier_versions_lack_the_ellipses_only(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    found = paper_map()
    old = {
        f.name: getattr(found, f.name)
        for f in dataclasses.fields(FieldMap)
        if not f.name.endswith("2")
    }
    np.savez(tmp_path / "field_map.npz", **old)
    loaded = FieldMap.load(tmp_path / "field_map.npz")
    assert loaded.covariance_absolute_arcsec2 is None
    assert loaded.equivalent_principal_point_px is None
    assert "Equivalent" not in loaded._repr_html_()
    assert isinstance(loaded.plot.maps(), Figure)
    loaded.save(tmp_path / "again.npz")
    assert FieldMap.load(tmp_path / "again.npz").covariance_compensated_arcsec2 is None
    assert "compensated_xy_arcsec2" in found.to_dataframe()
    assert "compensated_xy_arcsec2" not in loaded.to_dataframe()
