"""A camera whose pixel pitch nobody states: pixels everywhere, millimetres nowhere, and a way to
state it.
"""

from __future__ import annotations

import html
import re

import pytest

import starcal_uq as sc
from starcal_uq.core.errors import CameraError, StudyError
from starcal_uq.studies.axes import camera_of

# A number with the unit, and the unit as the head of a column or the end of a name.
MILLIMETRES = re.compile(r"\d[\s\u00a0]*(?:mm|µm|um)\b|\[mm\]|>mm<|\bmm\b|_mm\b|_um\b")
STYLE = re.compile(r"<style.*?</style>|<svg.*?</svg>|<script.*?</script>", re.DOTALL)
TEXTS = (".html", ".csv", ".json", ".toml", ".yaml", ".cameramodel", ".tex", ".md", ".txt")
PITCH = 6.9


def camera(pixel_um=None):
    return sc.Camera(
        1024,
        1024,
        pixel_um,
        None,
        505.0,
        521.0,
        coefficients=(2e-9, 0.0),
        name="lens of the garden",
        focal_px=5114.0,
    )


def texts(folder):
    """What the files of a folder say, by name, without what only draws or explains the keys of a
    file.
    """
    for path in sorted(folder.rglob("*")):
        if path.suffix in TEXTS:
            said = html.unescape(STYLE.sub("", path.read_text("utf-8")))
            yield (
                path.name,
                "\n".join(line for line in said.splitlines() if not line.startswith("#")),
            )


def millimetres(said):
    """What looks like a length in millimetres, by where it stands, but for the line that says how
    to state it.
    """
    found = {}
    for name, words in said.items():
        bare = words.replace("--pixel-um", "").replace("as pixel_um", "")
        found[name] = MILLIMETRES.findall(re.sub(r'"\w+_[mu]m": null', "", bare))
    return {name: hits for name, hits in found.items() if hits}


@pytest.fixture(scope="module")
def stars(tmp_path_factory):
    path = tmp_path_factory.mktemp("stars") / "obs.ecsv"
    catalogue = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    obs = sc.simulate(catalogue, camera(PITCH), n_frames=20, min_stars=8, sigma_px=0.05, seed=4)
    # A simulation knows the truth, and with it the pitch.
    obs.with_meta(source="measured", truth=None).save(path)
    return path


def test_nothing_that_a_run_shows_or_writes_is_in_millimetres(cli, stars, tmp_path):
    camera().save(tmp_path / "camera.toml")
    words = f"run {stars} camera.toml -o run --steps 20 --draws 50 --ensembles 2"
    out, err = cli.ok(words, among=(0, 1))
    assert out.count("--pixel-um") == 1
    formats = "opencv ros kalibr mrcal tetra3 sip latex markdown covariance csv"
    for to in formats.split():
        cli.ok(f"export run --to {to} -o run/exported_{to}.txt")
    said = {"terminal": out + err, **dict(texts(tmp_path / "run"))}
    assert "pixels of unknown pitch" in said["report.html"]
    assert len(said) > 20
    assert millimetres(said) == {}
    # The camera that is written is in that state when it is read, in the formats of others as well.
    kept = sc.Camera.load(tmp_path / "run" / "calibrated.toml")
    for to, ending in (("opencv", "yaml"), ("kalibr", "yaml"), ("mrcal", "cameramodel")):
        cli.ok(f"export run/calibrated.toml --to {to} -o {to}.{ending}")
        other = sc.Camera.load(tmp_path / f"{to}.{ending}")
        assert other.pixel_um is None
        assert other.focal_mm is None
        assert other.focal_px == pytest.approx(kept.focal_px, rel=1e-14)


def test_the_pitch_can_be_stated(cli, stars, tmp_path):
    camera().save(tmp_path / "camera.toml")
    call = f"calibrate {stars} camera.toml"
    unknown, _ = cli.ok(f"{call} -o unknown --json")
    assert millimetres({"json": unknown}) == {}
    out, _ = cli.ok(f"{call} -o stated --pixel-um {PITCH}")
    # The search for millimetres finds them where there are some.
    assert len(millimetres({"terminal": out})["terminal"]) == 1
    assert millimetres(dict(texts(tmp_path / "stated"))).keys() >= {
        "camera.toml",
        "calibrated.toml",
    }
    assert "state it with --pixel-um" not in out
    with_pitch, without = (
        sc.Run(tmp_path / "stated").calibration,
        sc.Run(tmp_path / "unknown").calibration,
    )
    assert with_pitch.camera.focal_px == pytest.approx(without.camera.focal_px, rel=1e-9)
    assert with_pitch.camera.focal_mm == pytest.approx(35.2866, abs=0.01)
    said = "error: --pixel-um is 5, but the pixel pitch is stated as 6.9 um"
    cli.refuses(said, f"calibrate {stars} stated/camera.toml -o x --pixel-um 5")
    cli.refuses("add --pixel-um UM, or give focal_px", f"{call} -o x --start focal_mm=35")
    cli.ok(f"{call} -o y --start focal_px=5100")


def test_a_camera_without_a_pitch_keeps_its_pixels(tmp_path):
    unknown = camera()
    unknown.save(tmp_path / "camera.toml")
    assert sc.Camera.load(tmp_path / "camera.toml") == unknown
    stated = unknown.replace(pixel_um=PITCH)
    assert stated.focal_px == pytest.approx(unknown.focal_px, rel=1e-15)
    assert stated.focal_mm == pytest.approx(5114.0 * PITCH / 1000.0, rel=1e-15)
    again = stated.replace(pixel_um=None)
    assert again.focal_mm is None
    assert again.focal_px == pytest.approx(5114.0, rel=1e-15)
    # With a pitch, the focal length in millimetres is what stays where the pitch changes.
    assert stated.replace(pixel_um=2.0 * PITCH).focal_px == pytest.approx(2557.0)
    assert unknown.with_theta(unknown.theta) == unknown
    with pytest.raises(CameraError):
        unknown.replace(focal_mm=35.0)
    with pytest.raises(CameraError):
        unknown.length_mm(1.0)
    with pytest.raises(StudyError):
        camera_of(unknown, {"pixel_um": 5.0})
    finer = camera_of(unknown, {"pixels": 2048})
    assert finer.focal_px == pytest.approx(2.0 * unknown.focal_px)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (
            "focal_px = 5114.0\nfocal_mm = 35.0\n",
            "keys focal_mm and focal_px both state the focal length; remove one.",
        ),
        (
            "focal_mm = 35.0\n",
            "key pixel_um is missing; add the pitch of the pixels in micrometres",
        ),
        ("pixel_um = 5.0\n", "key focal_mm is missing"),
        ("focal_px = -1\n", "key focal_px is -1; write the focal length in pixels"),
    ],
)
def test_a_file_states_one_focal_length(tmp_path, keys, said):
    path = tmp_path / "camera.toml"
    path.write_text(f"[camera]\nwidth_px = 10\nheight_px = 10\nx0_px = 4.5\ny0_px = 4.5\n{keys}")
    with pytest.raises(CameraError, match=re.escape(said)):
        sc.Camera.load(path)
