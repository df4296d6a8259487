"""From images to a report at the command line, and the bootstrap behind it."""

from __future__ import annotations

import html
import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import starcal_uq as sc
from starcal_uq.pipeline.images import counted, epoch_of, observations_from_images
from starcal_uq.pipeline.refine import identify_and_calibrate
from starcal_uq.sky.neighbours import without_disturbed

N_IMAGES = 13
ESA = Path(__file__).resolve().parents[3] / "shared" / "data" / "esa-tetra3"


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    sc.simulation.render_frames(
        stars,
        sc.paper.paper_camera(),
        folder,
        n_frames=N_IMAGES,
        seed=3,
        times_utc=["2026-11-25T00:00:00"] * N_IMAGES,
    )
    return folder


def named(obs):
    return set(zip(obs.frame.tolist(), obs.star_id.tolist(), strict=True))


def test_simulated_images_go_through_the_commands_one_by_one(cli, tmp_path):
    sc.paper.paper_camera().save(tmp_path / "truth.toml")
    sc.paper.paper_start().save(tmp_path / "camera.toml")
    cli.ok("simulate truth.toml -o obs.parquet --frames 4 --images img --seed 1")
    assert len(list((tmp_path / "img").glob("*.fits"))) == 4
    cli.ok("centroid img -o centroids.parquet --camera camera.toml")
    document = cli.document("identify centroids.parquet camera.toml -o found.csv --max-mag 6")
    assert [frame["status"] for frame in document["frames"]] == ["identified"] * 4
    found, truth = (
        named(sc.load_observations(tmp_path / name)) for name in ("found.csv", "obs.parquet")
    )
    # Stars within six sigma of the edge are in the images but not in the table.
    assert len(found - truth) <= 0.03 * len(found)
    # The stars tell the camera as well.
    out, _ = cli.ok("identify centroids.parquet -o alone.csv --max-mag 6")
    assert "The stars alone tell the camera" in out
    # The images do not state the pitch of their pixels, and nobody makes one up.
    assert re.search(r"\dmm| mm\b|\bum\b", out) is None
    assert sc.Camera.load(tmp_path / "alone.toml").pixel_um is None
    alone = named(sc.load_observations(tmp_path / "alone.csv"))
    assert len(alone & found) > 0.9 * len(found)
    cli.refuses("needs the nominal camera", "run found.csv -o run")


@pytest.mark.slow
@pytest.mark.usefixtures("centroids_once")
def test_the_commands_one_by_one_give_what_run_gives(cli, frames, tmp_path):
    """To the last bit: centroid, identify and calibrate beside the steps of `run` up to its
    calibration.
    """
    sc.paper.paper_start().save(tmp_path / "camera.toml")
    camera = sc.Camera.load(tmp_path / "camera.toml")
    obs, _, found = observations_from_images([frames], camera, max_mag=6.0, directions="apparent")
    at_once = sc.Run(tmp_path / "at_once").calibrate(obs, found.rounds[0][0].nominal)
    cli.document(f"centroid {frames} -o c.csv --camera camera.toml")
    cli.ok("identify c.csv camera.toml -o o.ecsv --max-mag 6 --directions apparent")
    cli.ok("calibrate o.ecsv camera.toml -o steps")
    one_by_one = sc.Run(tmp_path / "steps").calibration
    stars = sc.load_observations(tmp_path / "o.ecsv")
    assert stars.data_hash == obs.data_hash
    np.testing.assert_array_equal(one_by_one.theta, at_once.theta)
    np.testing.assert_array_equal(one_by_one.covariance, at_once.covariance)
    assert stars.meta["directions"] == "apparent"


@pytest.mark.usefixtures("centroids_once")
def test_run_from_images_to_report(cli, frames, tmp_path):
    sc.paper.paper_start().save(tmp_path / "camera.toml")
    options = "--directions apparent --max-mag 6 --screen --steps 40 --ensembles 2 --draws 50"
    _, err = cli.ok(f"run {frames} camera.toml -o run {options}", among=(0, 1))
    assert "with the nominal camera" in err
    run = sc.runs.RunFolder(tmp_path / "run")
    assert "They were identified twice" in run.report.read_text("utf-8")
    assert len(pd.read_csv(run.path / "identification.csv")) == N_IMAGES
    assert sc.images.Centroids.load(run.path / "centroids.parquet").n_frames == N_IMAGES
    cal, truth = sc.Calibration.load(run.calibration), sc.paper.paper_camera().theta
    assert np.all(np.abs(cal.theta - truth) < 4.0 * cal.sigmas)
    # What centroiding predicted is what the calibration finds.
    assert cal.sigma_name == "sigma_scale"
    assert cal.sigma == pytest.approx(1.0, abs=0.1)
    _frames_are_shown(cli, run, frames)


def _frames_are_shown(cli, run, images):
    """In the report, with their pixels, and by `inspect`, which says so where the images have
    moved.
    """
    report = run.report.read_text("utf-8")
    assert report.count("<figcaption>\n<h4>") == 12
    assert report.count("data:image/jpeg;base64,") == 12
    assert f"12 frames of {N_IMAGES}" in report
    held = sc.Run(run.path)
    table = held.frames.to_dataframe()
    assert (
        table["n_detected"].sum()
        == sc.images.Centroids.load(run.path / "centroids.parquet").n_stars
    )
    assert table["n_identified"].sum() == held.observations.n_stars
    assert table["n_matched"].sum() == sum(row.n_last for row in held.images.rows)
    # Whatever screening has left out is marked, with its reason.
    rejected = pd.read_csv(run.rejected)
    left_out = [frame.detections.query("kind == 'left out'") for frame in held.frames]
    assert sum(map(len, left_out)) == table["n_matched"].sum() - table["n_identified"].sum()
    assert set(rejected["star_id"]) <= {star for part in left_out for star in part["star_id"]}
    found = cli.document("inspect run")
    assert (found["text"], found["page"]) == (
        f"{N_IMAGES} frames; {N_IMAGES} of them took part in the calibration.",
        "run/frames.html",
    )
    assert run.inspection.read_text("utf-8").count("data:image/jpeg") == N_IMAGES
    cli.refuses("", "inspect run")
    name = held.images.rows[3].image
    out, _ = cli.ok(f"inspect run {name} 0 -o two.html --images {run.path}")
    assert f"Frame 3, {name}: calibrated" in out
    page = (run.path.parent / "two.html").read_text("utf-8")
    assert "data:image" not in page and "are not where the run found them" in page
    said = "17: the run has no frame of this number or name; the last one is 12"
    cli.refuses(said, "inspect run 17")


def test_options_of_the_other_kind_are_refused(cli, frames, tmp_path):
    sc.paper.paper_start().save(tmp_path / "camera.toml")
    words = f"run {frames} camera.toml -o run --observer-velocity 7,0,0"
    cli.refuses("--observer-velocity belongs to tables", words)
    (tmp_path / "obs.csv").write_text("frame,x_px,y_px,ra_deg,dec_deg\n")
    for option in ("--max-mag 3", "--gain 1", "--engine pyramid", "--focal-tolerance 0.1"):
        said = f"{option.split()[0]} belongs to images"
        cli.refuses(said, f"run obs.csv camera.toml -o run {option}")
    assert not (tmp_path / "run").exists()


def test_identify_refuses_the_calibration_of_another_sensor(cli, frames, tmp_path):
    obs = sc.simulate(
        sc.load_catalogue(max_mag=6.0, epoch=2026.9), sc.paper.paper_camera(), n_frames=20, seed=1
    )
    sc.Run(tmp_path / "run").calibrate(obs, sc.paper.paper_start(), force=True)
    sc.paper.paper_start().replace(focal_mm=50.0).save(tmp_path / "other.toml")
    cli.ok(f"centroid {frames} -o c.parquet")
    cli.refuses("one sensor", "identify c.parquet other.toml -o o.csv --calibration run")


@pytest.mark.usefixtures("centroids_once")
def test_too_few_stars_say_what_was_identified(cli, frames, tmp_path, monkeypatch):
    def stuck(*_arguments, **_options):
        raise sc.errors.CalibrationError("it went nowhere.")

    monkeypatch.setattr("starcal_uq.calibration.calibrate.calibrate", stuck)
    sc.paper.paper_start().save(tmp_path / "camera.toml")
    err = cli.refuses(
        f"stars in {N_IMAGES} frames were identified, but they do not determine the camera (it "
        "went nowhere.)",
        f"run {frames} camera.toml -o run --max-mag 6 --in-space",
    )
    # What was found in the images was said before.
    assert f"stars in {N_IMAGES} frames.\n" in err
    assert "identified, not calibrated" in (tmp_path / "run" / "frames.html").read_text("utf-8")


def test_bootstrap_says_what_changed(frames):
    table = sc.images.extract_centroids(frames)
    stars = sc.load_catalogue(max_mag=6.0, epoch=epoch_of(table))
    found = identify_and_calibrate(table, sc.paper.paper_start(), stars)
    assert len(found.rounds) == 2
    assert found.identification.n_identified == N_IMAGES
    assert "new" in found.text
    assert "standard deviations" in found.text
    # The focal length is compared with the data sheet's, not with that of the first calibration.
    change = 100.0 * abs(found.calibration.camera.focal_px / sc.paper.paper_start().focal_px - 1.0)
    assert f"{change:.2f} % shorter" in found.identification.text
    none = table.select_frames([])
    with pytest.raises(sc.errors.IdentificationError):
        identify_and_calibrate(none, sc.paper.paper_start(), stars)


def test_bad_input_is_one_sentence(cli, tmp_path):
    sc.paper.paper_start().save(tmp_path / "camera.toml")
    (tmp_path / "broken.fits").write_bytes(b"SIMPLE  =                    T")
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "empty").mkdir()
    for command in (
        "centroid missing.fits -o c.csv",
        "centroid empty -o c.csv",
        "identify missing.csv camera.toml -o o.csv",
        "run broken.fits camera.toml -o run",
        "run one.csv two.csv camera.toml -o run",
        "run camera.toml -o run",
        "simulate camera.toml -o s.csv --sensor x.toml",
    ):
        cli.refuses("", command)
    _, err = cli.ok("centroid broken.fits text.png -o d.csv", among=(1,))
    assert err.strip() and "Traceback" not in err
    assert not (tmp_path / "run").exists()
    assert not (tmp_path / "o.csv").exists()


def test_one_message_for_many_images():
    assert counted(["a: dark.", "b: dark.", "c: odd."]) == ["2 images: dark.", "c: odd."]
    found = counted(["a1: 3 of 10 % left.", "b2: 12 of 10 % left.", "c: 1.5 of 9 % left."])
    assert found == ["3 images: 1.5 to 12 of 9 to 10 % left."]
    assert counted(["In all 7."]) == ["In all 7."]


@pytest.mark.slow
def test_rendered_frames_through_the_whole_chain(tmp_path):
    truth = sc.paper.paper_camera()
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    sc.simulation.render_frames(stars, truth, tmp_path, n_frames=60, seed=11)
    table = sc.images.extract_centroids(tmp_path)
    found = identify_and_calibrate(
        table,
        sc.paper.paper_start(),
        stars,
        prepare=lambda obs: without_disturbed(obs, stars, truth),
    )
    cal = found.calibration
    assert found.identification.n_identified == 60
    assert np.all(np.abs((cal.theta - truth.theta) / cal.sigmas) < 4.0)
    # Three standard errors of the scale of some 1,500 stars.
    assert cal.sigma == pytest.approx(1.0, abs=0.055)
    # The control: stars where they were eleven years before are not what the camera saw.
    old = sc.load_catalogue(max_mag=6.0, epoch=2016.0)
    control = identify_and_calibrate(
        table, sc.paper.paper_start(), old, prepare=lambda obs: without_disturbed(obs, old, truth)
    )
    assert control.calibration.sigma > 1.3


@pytest.mark.slow
@pytest.mark.usefixtures("centroids_once")
@pytest.mark.skipif(not ESA.is_dir(), reason="the real frames are not here")
def test_real_frames_from_images_to_the_report(cli, tmp_path):
    camera = ESA.parent / "esa_tetra3_camera.toml"
    sc.sky.Site(52.2, 4.42, pressure_hpa=1013.0, temperature_c=20.0, name="Noordwijk").save(
        tmp_path / "site.toml"
    )
    # Warnings only: the pixel phase that correction leaves, and a little with magnitude.
    _, err = cli.ok("run", ESA, camera, "-o", "run", "--site", "site.toml", "--screen")
    assert "was added to the noise of every star" in err
    run = sc.runs.RunFolder(tmp_path / "run")
    obs, cal = sc.load_observations(run.observations), sc.Calibration.load(run.calibration)
    assert 0.03 < obs.meta["noise_floor_px"] < 0.05
    assert cal.sigma == pytest.approx(1.0, abs=0.1)
    f = cal.theta[2]
    scale = np.array([1.0, 1.0, 1.0, f**2, f**4])
    independent = np.array(
        [[517.3, 1.0], [389.9, 1.4], [5116.54, 0.28], [0.078, 0.017], [1.5, 1.1]]
    )
    z = (cal.theta * scale - independent[:, 0]) / np.hypot(cal.sigmas * scale, independent[:, 1])
    assert np.all(np.abs(z) < 2.0), z
    report = run.report.read_text("utf-8")
    assert "Noordwijk" in report
    assert "8 of 8 images used" in report
    # The control: without the site f is too short, and the report neither believes nor hides it. A
    # frame without stars, of an odd name, is shown with its reason and the next command, which can
    # be given.
    dark, name = tmp_path / "night", "dark & <cold>.png"
    dark.mkdir()
    Image.fromarray(np.random.default_rng(1).normal(100.0, 5.0, (768, 1024)).astype(np.uint8)).save(
        dark / name
    )
    words = "-o bare --screen --steps 200 --effects none"
    _, err = cli.ok("run", ESA, dark, camera, *words.split(), among=(1,))
    assert "conditional on refraction" in err
    failed = sc.Run(tmp_path / "bare").frames[name]
    assert (failed.row.outcome, failed.solved) == ("too few stars", False)
    shown = (
        (tmp_path / "bare" / "report.html")
        .read_text("utf-8")
        .partition("<b>dark &amp; &lt;cold&gt;.png</b>")[2]
    )
    command = html.unescape(re.search("<b>Next:</b>.*?<code class=.next.>(.*?)</code>", shown)[1])
    cli.ok(*shlex.split(command)[1:], among=(0, 1))
    bare = sc.Calibration.load(sc.runs.RunFolder(tmp_path / "bare").calibration)
    assert (bare.theta[2] - 5116.54) / np.hypot(bare.sigmas[2], 0.28) < -5.0
