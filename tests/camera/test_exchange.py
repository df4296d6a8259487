"""Cameras for other programs, read by those programs' own libraries."""

import json
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.camera.exchange import CAMERA_FORMATS, export_camera
from starcal_uq.camera.projection import unproject
from starcal_uq.core.errors import CameraError, RunFolderError
from tests.helpers.outside import unit_vectors

F = 5116.0
CAMERAS = {
    "brown": sc.Camera(
        1024, 768, 6.9, F * 6.9e-3, 517.3, 389.9, "brown", (0.078 / F**2, 1.5 / F**4)
    ),
    "brown3": sc.Camera(2048, 2048, 5.5, 16.0, 1020, 1030, "brown3", (-3e-8, 1e-15, 2e-22)),
    "tangential": sc.Camera(
        2048, 1536, 5.5, 16.0, 1020, 730, "brown_tangential", (-3e-8, 1e-15, 2e-7, -1e-7)
    ),
    "inverse": sc.Camera(1024, 1024, 15.0, 49.0, 520, 505, "inverse", (2e-8, 1e-15)),
    "none": sc.Camera(640, 480, 10.0, 25.0, 300, 250, "none"),
    "stretched": sc.Camera(
        1024,
        768,
        14.0,
        60.0,
        500,
        390,
        "brown_tangential+axes",
        (-3e-8, 1e-15, 2e-7, -1e-7, 0.1, 0.0),
    ),
    "prism": sc.Camera(
        1024, 768, 14.0, 60.0, 500, 390, "thin_prism", (-3e-8, 1e-15, 2.3e-7, 4.5e-7)
    ),
    "cubic": sc.Camera(
        1024,
        768,
        14.0,
        60.0,
        500,
        390,
        "cubic",
        (3e-7, 1e-7, 0, *[-3e-8] * 4, 2e-7, 0, 1e-7, *[2e-8] * 4),
    ),
    "skewed": sc.Camera(1024, 768, 14.0, 60.0, 500, 390, "brown+axes", (-3e-8, 1e-15, -0.05, 2e-3)),
}
OPENCV_LIKE = ("opencv", "ros", "kalibr", "mrcal", "giant")


def pixels(camera):
    x, y = np.meshgrid(
        np.linspace(0, camera.width_px - 1, 9), np.linspace(0, camera.height_px - 1, 7)
    )
    return np.stack([x.ravel(), y.ravel()], axis=1)


def largest(difference):
    return float(np.max(np.linalg.norm(difference, axis=-1)))


@pytest.fixture(params=CAMERAS)
def camera(request):
    return CAMERAS[request.param]


def test_opencv_reads_its_file_and_projects_alike(camera, tmp_path):
    cv2 = pytest.importorskip("cv2")
    made = export_camera(camera, "opencv", tmp_path / "c.yaml")
    storage = cv2.FileStorage(str(made.path), cv2.FILE_STORAGE_READ)
    matrix, coefficients = (
        storage.getNode("camera_matrix").mat(),
        storage.getNode("distortion_coefficients").mat(),
    )
    assert int(storage.getNode("image_width").real()) == camera.width_px
    seen = unproject(camera, pixels(camera))
    theirs = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, coefficients)[0].reshape(
        -1, 2
    )
    assert largest(theirs - pixels(camera)) <= made.error_px + 1e-9
    # A principal point that counts from the corner of the first pixel would be seen.
    matrix[0, 2] += 0.5
    moved = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, coefficients)[0].reshape(
        -1, 2
    )
    assert largest(moved - pixels(camera)) > 0.4


def test_mrcal_reads_its_files_and_projects_alike(tmp_path):
    python = "/usr/bin/python3"
    if not Path(python).exists():
        pytest.skip("mrcal is a package of the system, which has none")
    made = {
        name: export_camera(camera, "mrcal", tmp_path / f"{name}.cameramodel")
        for name, camera in CAMERAS.items()
    }
    for name, camera in CAMERAS.items():
        np.save(tmp_path / f"{name}_v.npy", np.ascontiguousarray(unproject(camera, pixels(camera))))
    code = (
        "import sys\ntry: import mrcal, numpy as np\nexcept ImportError: sys.exit(77)\nfor name "
        "in sys.argv[1:]:\n"
        " m = mrcal.cameramodel(f'{name}.cameramodel')\n"
        " xy = mrcal.project(np.load(f'{name}_v.npy'), *m.intrinsics())\n"
        " np.save(f'{name}_xy.npy', xy); print(*m.imagersize())"
    )
    done = subprocess.run(
        [python, "-c", code, *CAMERAS], cwd=tmp_path, capture_output=True, text=True
    )
    if done.returncode == 77:
        pytest.skip("mrcal is a package of the system, which has none")
    assert done.stdout.split("\n")[:-1] == [
        f"{c.width_px} {c.height_px}" for c in CAMERAS.values()
    ], done.stderr
    for name, camera in CAMERAS.items():
        off = np.load(tmp_path / f"{name}_xy.npy") - pixels(camera)
        assert largest(off) <= made[name].error_px + 1e-4, name


def test_tetra3rs_reads_its_file_and_sees_the_same_directions(camera, tmp_path):
    library = pytest.importorskip("tetra3rs")
    made = export_camera(camera, "tetra3rs", tmp_path / "c.bin")
    theirs = library.CameraModel.load_from_file(str(made.path))
    assert (theirs.image_width, theirs.image_height) == (camera.width_px, camera.height_px)
    seen = unproject(camera, pixels(camera))
    plane = [theirs.pixel_to_tanplane(*map(float, xy)) for xy in pixels(camera) - camera.centre_px]
    off = largest(camera.focal_px * (plane - seen[:, :2] / seen[:, 2:]))
    # Pixels of a distorted or stretched image are other angles than those of the plane.
    assert off <= 1.1 * made.error_px + 1e-5


@pytest.mark.extra("images")
def test_a_header_with_sip_gives_the_angles_between_pixels(camera, tmp_path):
    from astropy.io.fits import Header
    from astropy.wcs import WCS

    made = export_camera(camera, "sip", tmp_path / "c.hdr")
    wcs = WCS(Header.fromtextfile(made.path))
    theirs = unit_vectors(*wcs.all_pix2world(pixels(camera), 0).T)
    seen = unproject(camera, pixels(camera))
    # The rotation between them, which must be none of a mirror.
    u, _, v = np.linalg.svd(theirs.T @ seen)
    assert np.linalg.det(u @ v) > 0.0
    assert largest(camera.focal_px * (theirs - seen @ (u @ v).T)) < 2.0 * made.error_px + 1e-6
    # AP and BP bring directions back to pixels without iteration.
    stretch, skew = camera.axes
    ideal = camera.focal_px * seen[:, :2] / seen[:, 2:] @ [[1.0, 0.0], [skew, 1.0 + stretch]]
    back = wcs.sip_foc2pix(ideal, 1) - 1.0
    assert largest(back - pixels(camera)) <= made.error_px + 1e-6


def test_tetra3_states_the_field_and_distortion_that_it_takes(tmp_path):
    camera = CAMERAS["brown"].data_sheet().replace(coefficients=(0.078 / F**2, 0.0))
    made = export_camera(camera, "tetra3", tmp_path / "c.json")
    stated = json.loads(made.path.read_text())
    # Its own formula, written again: r_u = r_d (1 - k (2 r_d / w)^2) / (1 - k), and the field of
    # the undistorted width.
    k, half = stated["distortion"], camera.width_px / 2.0
    offsets = pixels(camera) - camera.centre_px
    undone = offsets * (1.0 - k * np.sum((offsets / half) ** 2, axis=1, keepdims=True)) / (1.0 - k)
    focal = half / np.tan(np.radians(stated["fov_estimate"] / 2.0))
    seen = unproject(camera, pixels(camera))
    off = largest(undone - focal * seen[:, :2] / seen[:, 2:])
    assert off <= made.error_px + 1e-9 < 0.01
    # Without its distortion the same camera is farther off.
    assert largest(offsets - focal * seen[:, :2] / seen[:, 2:]) > 10.0 * off


def test_asdf_holds_the_camera(camera, tmp_path):
    asdf = pytest.importorskip("asdf")
    made = export_camera(camera, "asdf", tmp_path / "c.asdf")
    with asdf.open(made.path) as content:
        assert sc.Camera.from_dict(content["camera"]) == camera
        assert np.array_equal(content["theta_px"], camera.theta)


@pytest.mark.parametrize("to", OPENCV_LIKE)
def test_what_is_written_is_read_again(camera, to, tmp_path):
    made = export_camera(camera, to, tmp_path / f"c{CAMERA_FORMATS[to].ending}")
    back = sc.Camera.load(made.path)
    seen = unproject(camera, pixels(camera))
    assert largest(sc.camera.project(back, seen) - pixels(camera)) <= made.error_px + 1e-8
    assert (back.width_px, back.height_px, back.pixel_um) == (
        camera.width_px,
        camera.height_px,
        camera.pixel_um,
    )
    # Terms that the format has are held; others are said to be fitted.
    skewed = camera.axes[1] != 0.0
    fitted = camera.distortion in ("inverse", "cubic") or (camera.distortion, to) == (
        "brown3",
        "kalibr",
    )
    fitted = fitted or (skewed and to in ("kalibr", "mrcal"))
    fitted = fitted or (camera.distortion == "thin_prism" and to in ("ros", "kalibr"))
    assert ("fitted" in made.note) == fitted
    assert (made.error_px > 0.0) == (fitted or (skewed and to != "giant"))
    if not fitted:
        # Skew too, which OpenCV's own functions leave out.
        assert np.allclose(back.to_opencv()[0], camera.to_opencv()[0], rtol=1e-14, atol=1e-14)
    if (camera.distortion, to) == ("brown3", "kalibr"):
        assert made.error_px > 0.05


def test_the_camera_of_giant_projects_alike(camera, tmp_path):
    """Its `OpenCVModel`, written again from its documentation, in NumPy alone."""
    made = export_camera(camera, "giant", tmp_path / "c.xml")
    model = ElementTree.parse(made.path).getroot()[0]
    assert (model.get("module"), model.get("type")) == (
        "giant.camera_models.opencv_model",
        "OpenCVModel",
    )
    # As its own reader takes them: by their text in Python.
    held = {node.tag: eval(node.text, {"array": np.array}) for node in model}
    assert (held["n_cols"], held["n_rows"]) == (camera.width_px, camera.height_px)
    k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4 = held["distortion_coefficients"]
    seen = unproject(camera, pixels(camera))
    x, y = (seen[:, :2] / seen[:, 2:]).T
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    moved = np.stack(
        [
            radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2,
            radial * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
            np.ones_like(x),
        ]
    )
    theirs = (held["intrinsic_matrix"] @ moved).T
    assert largest(theirs - pixels(camera)) <= made.error_px + 1e-9


@pytest.mark.parametrize("to", ["opencv", "ros", "kalibr"])
@pytest.mark.parametrize("model", ["f_theta", "equidistant", "fisheye+axes"])
def test_a_fisheye_is_written_and_read_without_loss(model, to, tmp_path):
    axes = (5e-3, 0.0) if model.endswith("+axes") else ()
    lens = {"f_theta": (), "equidistant": (-2e-7, 1e-14)}.get(model, (-2e-7, 1e-14, 1e-20, -1e-27))
    camera = sc.Camera(1024, 768, 5.0, 2.0, 500, 390, model, (*lens, *axes))
    made = export_camera(camera, to, tmp_path / f"c{CAMERA_FORMATS[to].ending}")
    back = sc.Camera.load(made.path)
    assert made.error_px == 0.0
    assert (
        largest(sc.camera.project(back, unproject(camera, pixels(camera))) - pixels(camera)) < 1e-9
    )


@pytest.mark.parametrize("to", ["mrcal", "giant", "sip", "tetra3"])
def test_a_format_without_fisheye_refuses_a_field_that_no_pinhole_has(to, tmp_path):
    wide = sc.Camera(1024, 768, 5.0, 2.0, 500, 390, "f_theta")
    with pytest.raises(CameraError, match="too wide for a pinhole"):
        export_camera(wide, to, tmp_path / "c")
    narrow = wide.replace(focal_px=4000.0)
    assert export_camera(narrow, to, tmp_path / "c").error_px < 1.0


def test_no_camera_is_lost_or_made_up(tmp_path):
    camera = CAMERAS["brown"]
    path = export_camera(camera, "ros", tmp_path / "c.yaml").path
    with pytest.raises(RunFolderError):
        export_camera(camera, "ros", path)
    with pytest.raises(CameraError, match="no format for a camera"):
        export_camera(camera, "word", path, force=True)
    folds = camera.replace(coefficients=(-1e-6, 0.0))
    with pytest.raises(CameraError, match="folds over"):
        export_camera(folds, "opencv", path, force=True)
    assert np.allclose(sc.Camera.load(path).theta, camera.theta, rtol=1e-14)
    text = path.read_text()
    for old, new, said in (
        ("plumb_bob", "thin", "distortion model is 'thin'"),
        ("camera_matrix", "matrix", "has none of camera_matrix"),
        ("image_width: 1024", "image_width: wide", "is not a camera of OpenCV"),
        (text, "", "is empty"),
        (text, "{'lensmodel': 'LENSMODEL_CAHVOR'}", "CAHVOR"),
        (text, 2000 * "[", "is not a camera"),
        (text, "<CameraModels><a type='OwenModel'/></CameraModels>", "one OpenCVModel is read"),
        (text, "<CameraModels><a type='OpenCVModel'/></CameraModels>", "no matrix of 2 x 3"),
        (text, "<CameraModels>", "is not a camera"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(CameraError, match=said):
            sc.Camera.load(path)
