"""Sensitivities of attitudes against a solver of Wahba's problem that is written here, in NumPy."""

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.errors import SettingError
from starcal_uq.propagation.tolerance import sensitivities

FIELD_DEG, SIZE_PX = 16.4, 1024
SHEET = sc.Camera(
    width_px=SIZE_PX,
    height_px=SIZE_PX,
    x0_px=511.5,
    y0_px=511.5,
    pixel_um=None,
    focal_mm=None,
    focal_px=float(0.5 * SIZE_PX / np.tan(np.radians(0.5 * FIELD_DEG))),
    distortion="k1",
    coefficients=(1e-9,),
)


def rotations(n: int, rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.standard_normal((n, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    return q * np.linalg.det(q)[:, None, None]


def tracker_frames(n: int, seed: int, stars: int = 9) -> sc.Observations:
    """Frames of a tracker that uses the brightest stars of G < 5.5 in a field of 16.4 degrees."""
    sky, rng = sc.load_catalogue(max_mag=5.5), np.random.default_rng(seed)
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("frame", "x", "y", "i")}
    for k, turn in enumerate(rotations(n, rng)):
        v = sky.directions_icrs @ turn.T
        front = v[:, 2] > 0.5
        xy = np.full((len(v), 2), np.inf)
        xy[front] = SHEET.focal_px * v[front, :2] / v[front, 2:] + 511.5
        seen = np.flatnonzero(np.all((xy > -0.5) & (xy < SIZE_PX - 0.5), axis=1))
        used = seen[np.argsort(sky.mag[seen], kind="stable")][:stars]
        if len(used) < 4:
            continue
        for name, values in zip(columns, (np.full(len(used), k), *xy[used].T, used), strict=True):
            columns[name].append(values)
    frame, x, y, i = (np.concatenate(values) for values in columns.values())
    return sc.Observations(
        frame=frame,
        x_px=x,
        y_px=y,
        ra_deg=sky.ra_deg[i.astype(int)],
        dec_deg=sky.dec_deg[i.astype(int)],
    )


@pytest.fixture(scope="module")
def frames() -> sc.Observations:
    return tracker_frames(3000, 5)


def attitude(b: np.ndarray, r: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(b.T @ r)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt


def pinhole(xy: np.ndarray, x0: float, y0: float, f: float) -> np.ndarray:
    v = np.column_stack([xy - [x0, y0], np.full(len(xy), f)])
    return v / np.linalg.norm(v, axis=1)[:, None]


def test_a_wrong_parameter_turns_attitudes_as_stated(frames: sc.Observations) -> None:
    camera = SHEET.replace(distortion="none", coefficients=())
    found = sensitivities(camera, frames)
    errors = np.eye(3) * [0.01, 0.01, 1e-4 * SHEET.focal_px]
    for name, (dx, dy, df) in zip(("x0", "y0", "f"), errors, strict=True):
        turned = []
        for a, z in zip(frames.frame_starts[:200], frames.frame_starts[1:201], strict=True):
            xy, r = frames.xy[a:z], frames.directions_icrs[a:z]
            true = attitude(pinhole(xy, 511.5, 511.5, SHEET.focal_px), r)
            seen = attitude(pinhole(xy, 511.5 + dx, 511.5 + dy, SHEET.focal_px + df), r)
            delta = seen @ true.T
            turned.append(
                [delta[2, 1] - delta[1, 2], delta[0, 2] - delta[2, 0], delta[1, 0] - delta[0, 1]]
            )
        simulated = np.degrees(0.5 * np.array(turned)) * 3600.0
        stated = found.turns_arcsec[:200, :, ("x0", "y0", "f").index(name)] * (dx + dy + df)
        scale = np.abs(simulated).max()
        # The sign is that of the rotation from the true attitude to the one with the wrong camera.
        np.testing.assert_allclose(stated, simulated, atol=2e-3 * scale)
        # Control: the other sign, or axes in another order, would be seen.
        assert np.abs(stated + simulated).max() > 0.5 * scale
        assert np.abs(stated[:, [1, 0, 2]] - simulated).max() > 0.5 * scale


def test_the_focal_length_of_a_wide_tracker(frames: sc.Observations) -> None:
    """1e-4 of f: 0.69 arcsec in the median, 1.46 for 95 % and 2.06 for 99.7 % of the frames."""
    found = sensitivities(SHEET, frames)
    df = 1e-4 * SHEET.focal_px
    stated = [df * found.error_arcsec("f", confidence=c) for c in (0.5, 0.95, 0.997)]
    assert stated == pytest.approx([0.69, 1.46, 2.06], rel=0.06)
    print("1e-4 of f, arcsec:", np.round(stated, 2))
    # Control: a tracker that uses 4 stars errs by another amount.
    fewer = sensitivities(SHEET, tracker_frames(1000, 6, stars=4))
    assert df * fewer.error_arcsec("f", confidence=0.5) != pytest.approx(0.69, rel=0.06)


def test_a_tolerance_keeps_its_limit(frames: sc.Observations) -> None:
    found = sensitivities(SHEET, frames)
    kept = found.tolerance("f", 1.0, confidence=0.95)
    angles = np.linalg.norm(found.turns_arcsec[:, :2, 2] * kept, axis=1)
    assert np.mean(angles <= 1.0) == pytest.approx(0.95, abs=1e-3)
    # Alignment takes up nearly all of the principal point's error, and hardly any of f's.
    for name, share in (("x0", 0.05), ("f", 1.0)):
        ratio = found.tolerance(name, 1.0) / found.tolerance(name, 1.0, aligned=True)
        assert ratio == pytest.approx(share, abs=0.05), name
    table = found.to_dataframe(limit_arcsec=1.0, confidence=0.95)
    row = table[(table.parameter == "f") & (table.axis == "cross-boresight")].iloc[0]
    assert row["tolerance"] == kept and row["unit"] == "px"
    assert len(table) == 4 * 4
    with pytest.raises(SettingError, match="parameter 'k2' is unknown"):
        found.tolerance("k2", 1.0)
    with pytest.raises(SettingError, match="confidence"):
        found.tolerance("f", 1.0, confidence=2.0)
