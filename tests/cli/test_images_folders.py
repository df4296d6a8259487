"""Folders of pictures as they come: few stars, other cameras, damaged files, nothing that is a
star.
"""

from __future__ import annotations

import html
import re
import shlex

import numpy as np
import pytest
from PIL import Image

import starcal_uq as sc
from starcal_uq.cli.answers import Answer
from starcal_uq.core.errors import CalibrationError
from starcal_uq.pipeline.images import observations_from_images
from tests.helpers.sky_pictures import SIZE, attitude, picture

FAST = "--steps 20 --draws 50 --ensembles 2"


def sheet(path, focal_px, model="brown"):
    centre = 0.5 * (SIZE - 1)
    sc.Camera(SIZE, SIZE, 10.0, 1e-2 * focal_px, centre, centre, model).save(path)


@pytest.fixture
def noisy_frame(tmp_path):
    """One frame whose bright stars show so much noise that the terms of its sheet's model are
    open.
    """
    rng = np.random.default_rng(2)
    rng.integers(4)
    picture(tmp_path / "frame.tiff", attitude(rng), 6000.0, jitter_px=0.4, max_mag=9.0, seed=2)
    sheet(tmp_path / "camera.toml", 6000.0)
    return tmp_path / "frame.tiff"


@pytest.mark.slow
def test_a_model_that_is_asked_for_is_fitted_whatever_the_sheet_has(
    cli, noisy_frame, tmp_path, monkeypatch
):
    # What follows the calibration is not asked about.
    monkeypatch.setattr("starcal_uq.runs.whole.finish", lambda *_, **__: None)
    monkeypatch.setattr("starcal_uq.cli.run._conclude", lambda run: Answer({"run": run.path}))
    cli.ok(f"run {noisy_frame} camera.toml -o run --model none {FAST}", among=(0, 1))
    assert sc.Run(tmp_path / "run").calibration.camera.distortion == "none"


@pytest.mark.slow
def test_images_fall_back_to_a_simpler_model_as_a_table_does(noisy_frame, tmp_path):
    camera = sc.Camera.load(tmp_path / "camera.toml")
    obs, _, found = observations_from_images([noisy_frame], camera)
    assert obs.meta["noise_floor_px"] == pytest.approx(0.4, rel=0.3)
    cal = sc.calibrate(obs, found.rounds[0][0].nominal)
    assert cal.camera.distortion == "none"
    assert cal.provenance["fallback"]["model"] == "brown"
    # What is asked for by name is fitted or refused there as well, and the way out leads out.
    with pytest.raises(CalibrationError, match="'none' converges"):
        sc.calibrate(obs, found.rounds[0][0].nominal, model="brown")


def page_of(folder):
    return html.unescape((folder / "frames.html").read_text("utf-8"))


def test_a_failed_identification_leaves_a_folder_with_every_frame(cli, tmp_path):
    """Detections that are no stars, a file that is no image, and too little light: each with its
    reason.
    """
    rng = np.random.default_rng(5)
    frames = tmp_path / "frames"
    frames.mkdir()
    for k in range(2):
        counts = rng.normal(500.0, 10.0, (SIZE, SIZE))
        x, y = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
        for place in rng.uniform(20.0, SIZE - 20.0, (6, 2)):
            counts += 4000.0 * np.exp(
                -0.5 * np.sum((np.stack([x, y], axis=-1) - place) ** 2, axis=-1) / 1.2
            )
        Image.fromarray(counts.astype(np.uint16)).save(frames / f"noise{k}.tiff")
    Image.fromarray(rng.normal(500.0, 10.0, (SIZE, SIZE)).astype(np.uint16)).save(
        frames / "dark.tiff"
    )
    (frames / "text.png").write_text("no picture")
    sheet(tmp_path / "camera.toml", 3000.0)
    said = "error: no frame is identified: 0 of 3 frames are identified."
    err = cli.refuses(said, "run frames camera.toml -o run --max-mag 5")
    assert err.rstrip().endswith("Every frame, with its detections and its reason: run/frames.html")
    page = page_of(tmp_path / "run")
    for name in ("noise0.tiff", "noise1.tiff", "dark.tiff", "text.png"):
        assert name in page
    assert page.count(">not identified<") == 2
    assert page.count(">too few stars<") == 1
    assert "the file is not an image, is damaged, or is of a kind that is not read<" in page
    # Detections are marked where they are.
    assert page.count('<g class="u">') == 2
    # What the page names works, and the folder is no obstacle to another attempt.
    command = shlex.split(re.search(r"(starcal-uq identify [^<]*)<", page)[1])[1:]
    assert "0 of 3 frames are identified" in cli.ok(*command, among=(1,))[0]
    shown = cli.document("inspect run --force")["frames"]
    assert [frame["outcome"] for frame in shown][1:3] == 2 * ["not identified"]


@pytest.mark.slow
def test_stars_that_do_not_determine_the_camera_are_shown_as_well(cli, tmp_path):
    rng = np.random.default_rng(0)
    rng.integers(4)
    picture(tmp_path / "frame.tiff", attitude(rng), 6000.0, jitter_px=0.4, max_mag=9.0, seed=0)
    sheet(tmp_path / "camera.toml", 6000.0)
    cli.refuses("they do not determine the camera", "run frame.tiff camera.toml -o run")
    assert ">identified, not calibrated<" in page_of(tmp_path / "run")
    # A run of something else takes the place of what has failed.
    Image.fromarray(rng.normal(500.0, 10.0, (SIZE, SIZE)).astype(np.uint16)).save(
        tmp_path / "dark.tiff"
    )
    cli.refuses("no frame is identified", "run dark.tiff camera.toml -o run")
    left = {path.name for path in (tmp_path / "run").iterdir() if not path.name.startswith(".")}
    images = {"centroids.parquet", "frames.html", "identification.csv", "images.json"}
    assert left == {"camera.toml", "run.json", *images}


def test_a_call_that_lacks_an_argument_is_answered_with_a_sentence(cli):
    file, folder = shlex.quote(__file__), "-o RUN is missing (folder for the results): give"
    for call, said in {
        "calibrate": (
            "OBS is missing (stars in pixels): give `starcal-uq calibrate OBS CAMERA -o RUN`."
        ),
        f"run {file}": f"{folder} `starcal-uq run OBS|IMAGES... [CAMERA] -o",
        f"calibrate {file} {file}": f"{folder} `starcal-uq calibrate",
        "sample": (
            "RUN is missing (run folder of `starcal-uq calibrate` or `run`): give `starcal-uq "
            "sample RUN`."
        ),
        f"export {file}": "--to WORD is missing (the camera for opencv",
    }.items():
        assert cli.refuses("", call).startswith(f"error: {said}")


@pytest.fixture
def mixed_folder(tmp_path):
    """Five pictures of one camera among what else lies in a folder: two of a longer lens, and what
    is no picture.
    """

    def made(longer):
        frames = tmp_path / "frames"
        frames.mkdir()
        rng = np.random.default_rng(3)
        for number in range(7):
            focal = 2400.0 * (longer if number in (2, 5) else 1.0)
            picture(frames / f"{number}.tiff", attitude(rng), focal, max_mag=8.0, seed=number)
        picture(frames / "small.tiff", attitude(rng), 2400.0, size=300, max_mag=8.0)
        whole = (frames / "0.tiff").read_bytes()
        (frames / "cut.tiff").write_bytes(whole[: len(whole) // 3])
        (frames / "raw.nef").write_bytes(b"II*\0")
        (frames / "empty.fits").write_bytes(b"")
        return frames

    return made


@pytest.mark.parametrize(
    ("longer", "with_sheet"), [pytest.param(1.75, False, marks=pytest.mark.slow), (1.015, True)]
)
def test_frames_of_another_camera_are_left_out(mixed_folder, tmp_path, longer, with_sheet):
    """One that is found by itself, and one that a sheet's tolerance takes for the same."""
    folder = mixed_folder(longer)
    sheet(tmp_path / "camera.toml", 2400.0)
    camera = sc.Camera.load(tmp_path / "camera.toml") if with_sheet else None
    obs, centroids, found = observations_from_images([folder], camera)
    assert np.unique(obs.frame).size == 5
    assert abs(found.calibration.camera.focal_px / 2400.0 - 1.0) < 2e-4
    why = dict(zip(centroids.image.tolist(), centroids.problem.tolist(), strict=True))
    for name in ("2.tiff", "5.tiff"):
        assert why[name].startswith(f"another camera took it: f = {2400.0 * longer:.4g}"[:-1])
    assert "truncated or damaged" in why["cut.tiff"]
    assert why["empty.fits"] == "the file is empty"
    assert (
        why["raw.nef"].startswith("raw files of cameras need rawpy") or "damaged" in why["raw.nef"]
    )
    assert why["small.tiff"].startswith("the image is 300 x 300 px")
    assert [name for name, words in why.items() if not words] == [
        f"{n}.tiff" for n in (0, 1, 3, 4, 6)
    ]
    # No noise of another lens is in that of the frames.
    assert obs.meta.get("noise_floor_px", 0.0) < 0.1


@pytest.mark.slow
def test_the_command_for_the_other_camera_works(cli, mixed_folder, tmp_path):
    mixed_folder(1.75)
    _, err = cli.ok(f"run frames -o run --directions apparent {FAST}", among=(0, 1))
    notes = [line for line in err.splitlines() if "of another camera" in line]
    assert [re.search(r"\((.*)\) left out", line)[1] for line in notes] == [
        "300 x 300 px",
        "f = 4200 px",
    ]
    command = shlex.split(notes[1].partition("to calibrate that one: ")[2])
    assert command[:2] == ["starcal-uq", "run"]
    assert command[-4:] == ["--directions", "apparent", "-o", "run-3"]
    cli.ok(*command[1:], *FAST.split(), among=(0, 1))
    assert sc.Run(tmp_path / "run-3").calibration.camera.focal_px == pytest.approx(4200.0, rel=1e-3)
    frames = sc.Run(tmp_path / "run").frames
    assert next(frame.row.outcome for frame in frames if frame.row.frame == 2).startswith(
        "another camera took it"
    )
    cli.ok("inspect run --force")
    assert "calibrate the frames of that camera by themselves" in page_of(tmp_path / "run")
