"""The camera: parameters and units, its file, OpenCV's parameters."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from starcal_uq.camera.camera import Camera
from starcal_uq.camera.distortion import get_model, model_names, simpler_models
from starcal_uq.core.errors import CameraError

PAPER = Camera(1024, 1024, 12.0, 70.2262, 500.0, 530.0, "brown", (2.0e-10, -3.5e-15))
TABLE = {
    "width_px": 1024,
    "height_px": 1024,
    "pixel_um": 12.0,
    "focal_mm": 70.2262,
    "x0_px": 500.0,
    "y0_px": 530.0,
    "distortion": "brown",
    "k1": 2.0e-10,
    "k2": -3.5e-15,
}


def awkward(distortion: str) -> Camera:
    """A camera none of whose numbers has a short decimal form."""
    n = len(get_model(distortion).coefficients)
    coefficients = tuple(-(10.0**-9.1) / 3**k for k in range(n))
    return Camera(
        640, 480, 10.0 / 3.0, math.pi * 7, 1 / 3, -2 / 7, distortion, coefficients, 'é "x"'
    )


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def file_text(**changes: object) -> str:
    """A camera file with keys changed, added, or (None) left out."""
    table: dict[str, object] = {**TABLE, **changes}
    return "[camera]\n" + "".join(
        f"{key} = {value!r}\n" for key, value in table.items() if value is not None
    )


def test_units():
    assert PAPER.focal_px == pytest.approx(70.2262 / 0.012, rel=1e-15)
    assert PAPER.parameter_names == ("x0", "y0", "f", "k1", "k2")
    np.testing.assert_allclose(
        PAPER.theta, [500.0, 530.0, 5852.183333333333, 2e-10, -3.5e-15], rtol=1e-15
    )
    assert PAPER.centre_px == (511.5, 511.5)
    # The paper's sensor is one of 10 degrees.
    assert PAPER.fov_deg[0] == pytest.approx(
        2 * math.degrees(math.atan(6.144 / 70.2262)), rel=1e-14
    )
    assert PAPER.fov_deg == pytest.approx((10.0, 10.0), abs=0.01)


def test_corner_radius_is_to_the_farthest_corner():
    assert PAPER.corner_radius_px == math.hypot(523.5, 530.5)
    outside = PAPER.replace(x0_px=-100.0, y0_px=2000.0)
    assert outside.corner_radius_px == math.hypot(1123.5, 2000.5)


def test_contains_the_whole_of_the_edge_pixels():
    xy = np.array(
        [
            [-0.5, -0.5],
            [1023.5, 1023.5],
            [-0.5001, 5.0],
            [5.0, 1023.5001],
            [np.nan, 5.0],
            [np.inf, 5.0],
        ]
    )
    np.testing.assert_array_equal(PAPER.contains(xy), [True, True, False, False, False, False])
    wide = PAPER.replace(height_px=100)
    np.testing.assert_array_equal(wide.contains([[1000.0, 50.0], [50.0, 1000.0]]), [True, False])


def test_with_theta_keeps_the_detector():
    theta = np.array([510.25, 512.5, 5900.125, 1e-10, 2e-15])
    moved = PAPER.with_theta(theta)
    np.testing.assert_allclose(moved.theta, theta, rtol=4e-16)
    assert (moved.width_px, moved.pixel_um, moved.distortion) == (1024, 12.0, "brown")
    with pytest.raises(CameraError, match=r"give 5 values \(x0, y0, f, k1, k2\)"):
        PAPER.with_theta(theta[:3])
    with pytest.raises(CameraError, match="finite"):
        PAPER.with_theta([510.0, np.nan, 5900.0, 0.0, 0.0])


def test_replace_carries_coefficients_by_name():
    tangential = PAPER.replace(distortion="brown_tangential")
    assert tangential.coefficients == (2e-10, -3.5e-15, 0.0, 0.0)
    assert tangential.replace(distortion="k1").coefficients == (2e-10,)
    assert PAPER.replace(distortion="inverse").coefficients == (
        0.0,
        0.0,
    )  # the same names mean the opposite direction
    assert PAPER.replace(distortion="none").coefficients == ()
    with pytest.raises(CameraError, match="no attribute 'focal'"):
        PAPER.replace(focal=3.0)
    with pytest.raises(CameraError, match="'unheard' is unknown"):
        PAPER.replace(distortion="unheard")


def test_is_frozen_and_comparable():
    assert PAPER.replace() == PAPER
    assert len({PAPER, PAPER.replace()}) == 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        PAPER.focal_mm = 1.0  # type: ignore[misc]


def test_numpy_values_become_plain():
    camera = Camera(np.int64(8), np.int32(6), np.float32(2.0), np.float64(3.0), 1, 2)
    assert [type(v) for v in dataclasses.astuple(camera)[:6]] == [
        int,
        int,
        float,
        float,
        float,
        float,
    ]
    assert camera.coefficients == (0.0, 0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width_px": 0}, "width_px is 0; it must be above 0"),
        ({"height_px": -5}, "height_px is -5"),
        ({"width_px": 10.5}, "width_px is 10.5; give a whole number"),
        ({"width_px": True}, "width_px is True; give a whole number"),
        ({"pixel_um": 0.0}, "pixel_um is 0.0; it must be above 0"),
        ({"focal_mm": -1.0}, "focal_mm is -1.0"),
        ({"x0_px": math.nan}, "x0_px is nan; give a finite number"),
        ({"y0_px": "left"}, "y0_px is 'left'; give a number"),
        ({"coefficients": (1e-10,)}, r"1 coefficients for distortion 'brown'; give 2 \(k1, k2\)"),
        ({"coefficients": (1e-10, math.inf)}, "k2 is inf"),
        ({"distortion": "unheard"}, "'unheard' is unknown: use one of none, k1, brown"),
    ],
)
def test_bad_values_are_refused(changes, message):
    with pytest.raises(CameraError, match=message):
        PAPER.replace(**changes)


@pytest.mark.parametrize("distortion", model_names())
def test_file_keeps_every_digit(tmp_path, distortion):
    camera = awkward(distortion)
    camera.save(tmp_path / "camera.toml")
    assert Camera.load(tmp_path / "camera.toml") == camera
    assert Camera.from_dict(camera.to_dict()) == camera


def test_file_states_the_conventions(tmp_path):
    PAPER.save(tmp_path / "camera.toml")
    text = (tmp_path / "camera.toml").read_text(encoding="utf-8")
    assert "(0, 0) is the centre of the first pixel" in text
    assert "ideal (pinhole) points to distorted" in text
    assert "name" not in text.split("[camera]")[1]
    awkward("inverse").save(tmp_path / "inverse.toml")
    assert "distorted (measured) points to ideal" in (tmp_path / "inverse.toml").read_text(
        encoding="utf-8"
    )


def test_file_by_hand(tmp_path):
    """Whole numbers for floats, a byte order mark and Windows line ends are all fine."""
    text = "[camera]\nwidth_px=10\nheight_px=8\npixel_um=5\nfocal_mm=50\nx0_px=4\ny0_px=3\n"
    path = tmp_path / "camera.toml"
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert Camera.load(path) == Camera(10, 8, 5.0, 50.0, 4.0, 3.0, "brown", (0.0, 0.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (file_text(focal_mm=None), "section [camera]: key focal_mm is missing; add the focal"),
        (file_text(focal_mm=None, x0_px=None), "key focal_mm is missing; add the focal length in"),
        (file_text(k3=1e-20), "key k3 is no coefficient of distortion 'brown' (it has k1, k2);"),
        (file_text(distortion="none"), "key k1 is no coefficient of distortion 'none'"),
        (file_text(k1=math.nan), "key k1 is nan; write the coefficient, a number from -1 to 1."),
        (file_text(distortion="unheard"), "key distortion: distortion model 'unheard' is unknown:"),
    ],
)
def test_bad_file_is_named_with_key_and_remedy(tmp_path, text, message):
    path = write(tmp_path / "cam.toml", text)
    with pytest.raises(CameraError) as caught:
        Camera.load(path)
    assert str(caught.value).startswith(f"{path}")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def matrix(fx=5000.0, fy=5000.0, skew=0.0):
    return np.array([[fx, skew, 500.0], [0.0, fy, 500.0], [0.0, 0.0, 1.0]])


def stated(**changes):
    table = {"width_px": 1000, "height_px": 1000, "pixel_um": 14.0, "focal_mm": 150.0}
    return table | {"x0_px": 500.0, "y0_px": 500.0} | changes


def test_two_pitches_state_the_stretch_of_the_axes(tmp_path):
    camera = Camera.from_dict(stated(pixel_um=[14.004, 13.995], distortion="k1", k1=1e-9))
    assert (camera.distortion, camera.pixel_um) == ("k1+axes", 14.004)
    matrix = camera.to_opencv()[0]
    assert matrix[0, 0] == pytest.approx(150e3 / 14.004, rel=1e-15)
    assert matrix[1, 1] == pytest.approx(150e3 / 13.995, rel=1e-15)
    camera.save(tmp_path / "camera.toml")
    assert Camera.load(tmp_path / "camera.toml") == camera
    path = tmp_path / "pair.toml"
    path.write_text(
        "[camera]\nwidth_px = 10\nheight_px = 10\npixel_um = [8, 9]\nfocal_mm = 1\n"
        "x0_px = 5\ny0_px = 5\n"
    )
    assert Camera.load(path).axes == (8.0 / 9.0 - 1.0, 0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel_um": [14.0]}, r"pixel_um is \[14.0\]; write one pitch"),
        ({"pixel_um": [14.0, "x"]}, "write one pitch"),
        ({"pixel_um": [14.0, -1.0]}, "write one pitch"),
        ({"pixel_um": [14.0, 13.9], "stretch": 0.1}, "stretch their ratio; remove one"),
        ({"stretch": 0.1}, "set distortion to 'brown\\+axes'"),
        ({"distortion": "brown+axes", "stretch": -1.0}, "stretch is -1.0; it must be above -1"),
        ({"distortion": "brown+tilt"}, "unknown: use one of none"),
    ],
)
def test_axes_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(CameraError, match=message):
        Camera.from_dict(stated(**changes))


def test_no_other_model_makes_pixels_square():
    camera = PAPER.replace(distortion="brown+axes", coefficients=(2e-10, -3.5e-15, 0.1, 0.0))
    assert simpler_models("brown+axes") == ("none+axes", "k1+axes")
    with pytest.raises(CameraError, match="use 'k1\\+axes'"):
        camera.replace(distortion="k1")
    assert camera.replace(distortion="inverse+axes").axes == (0.1, 0.0)
    assert camera.data_sheet().coefficients == (0.0, 0.0, 0.1, 0.0)
    square = PAPER.replace(distortion="brown+axes")
    assert square.replace(distortion="brown") == PAPER


def test_html_escapes_the_name():
    page = PAPER.replace(name="<script>")._repr_html_()
    assert "&lt;script&gt;" in page
    assert "<script>" not in page
    assert "k2" in page
