"""Direction uncertainty over the detector, against draws and rotations fitted one by one."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from starcal_uq.core.errors import DistortionError, RunFolderError
from starcal_uq.propagation.field import FieldMap, field_map
from tests.helpers.gaussian_camera import COVARIANCE
from tests.helpers.scenes import camera, observations

ARCSEC = 648_000.0 / np.pi


def posterior(covariance: np.ndarray = COVARIANCE, **changes: object) -> SimpleNamespace:
    cam = camera("brown", **changes)
    return SimpleNamespace(camera=cam, calibrated_camera=cam, mean=cam.theta, covariance=covariance)


@lru_cache
def paper_map() -> FieldMap:
    return field_map(posterior(), observations())


def test_principal_point_is_taken_up_by_the_rotation() -> None:
    found = paper_map()
    sigma_px = 0.15
    absolute = sigma_px / camera("brown").theta[2] * ARCSEC
    np.testing.assert_allclose(found.sigma_absolute_arcsec, absolute, rtol=0.03)
    assert found.sigma_compensated_arcsec.max() < 0.05 * absolute
    # Control: an error of the focal length alone is no rotation.
    only_f = field_map(posterior(np.diag([0, 0, 0.028**2, 0, 0])), observations())
    assert only_f.sigma_compensated_arcsec.max() > 0.9 * only_f.sigma_absolute_arcsec.max()


def test_broken_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "field_map.npz"
    for content in (b"", b"text", b"PK\x03\x04 cut"):
        path.write_bytes(content)
        with pytest.raises(RunFolderError, match=r"field_map\.npz: is not a field map"):
            FieldMap.load(path)
    np.savez(path, x_px=np.zeros(3))
    with pytest.raises(RunFolderError, match="is not a field map"):
        FieldMap.load(path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(RunFolderError, match="is not a field map"):
        FieldMap.load(tmp_path / "array.npy")
    with pytest.raises(
        RunFolderError,
        match=r"none\.npz: cannot be read .*; run `starcal-uq propagate RUN --force`",
    ):
        FieldMap.load(tmp_path / "none.npz")


def test_what_cannot_be_mapped_is_said() -> None:
    with pytest.raises(ValueError, match="at least 2 grid points"):
        field_map(posterior(), observations(), n=1)
    folded = posterior()
    folded.calibrated_camera = folded.camera.with_theta(folded.mean * np.array([1, 1, 1, -1e4, 1]))
    with pytest.raises(DistortionError, match="folds over"):
        field_map(folded, observations())


def test_equivalent_principal_point() -> None:
    """An error of x0 alone is itself; through the other parameters the point moves further."""
    only_x0 = field_map(posterior(np.diag([0.15**2, 0, 0, 0, 0])), observations())
    np.testing.assert_allclose(only_x0.equivalent_principal_point_px, [0.15, 0.0], atol=1e-9)
    arcsec = 0.15 / camera("brown").theta[2] * ARCSEC
    np.testing.assert_allclose(
        only_x0.equivalent_principal_point_arcsec, [arcsec, 0.0], atol=0.02 * arcsec
    )
    # A focal length error turns the field only because the principal point is off the centre.
    only_f = field_map(posterior(np.diag([0, 0, 0.028**2, 0, 0])), observations())
    assert 0.0 < only_f.equivalent_principal_point_px[1] < 0.028 * 50 / 5852
    found = paper_map()
    assert (found.equivalent_principal_point_px >= 0.149).all()
    assert "Equivalent principal point" in found._repr_html_()
    # Pitch goes with y0 and yaw with x0, not the other way round.
    assert (
        only_x0.rotation_covariance_arcsec2[0, 0] < 1e-6 * only_x0.rotation_covariance_arcsec2[1, 1]
    )


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
