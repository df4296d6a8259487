"""Known rotations between frames on the command line: given, shown, stored, found wrong, refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import starcal_uq as sc
from tests.helpers.effects import sheet, table
from tests.helpers.outside import campaign
from tests.helpers.ties import gyro, stare, write_columns


@pytest.fixture
def chain(tmp_path):
    """A table, its camera, and the rotations that a gyro measured between its frames."""
    rng = np.random.default_rng(21)
    c = campaign(rng, n_frames=12)
    obs, columns = table(c), gyro(rng, c, 2.0)
    obs.select(np.abs(obs.xy - 511.5).max(axis=1) < 511.0).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    write_columns(tmp_path / "gyro.csv", columns)
    return "obs.csv camera.toml"


GYRO = "--relative-attitudes gyro.csv"


def test_a_run_holds_the_rotations_and_its_draws_follow(cli, chain) -> None:
    words = f"run {chain} {GYRO} -o run --in-space --steps 40 --walkers 16 --ensembles 2"
    out, _ = cli.ok(words, among=(0, 1))
    assert "11 known rotations tie the attitudes of the frames: sigma of x0 and y0 is" in out
    run = sc.Run("run")
    cal, post = run.calibration, run.posterior
    assert cal.ties is not None
    assert cal.sigmas[0] < 0.05 * cal.ties.sigmas_without[0]
    assert post.sd[0] == pytest.approx(cal.sigmas[0], rel=0.3)
    checks = json.loads(Path("run/verdict.json").read_text("utf-8"))["checks"]
    (found,) = [check for check in checks if check["name"] == "Known rotations"]
    assert found["level"] == "pass"
    assert "Known rotations" in Path("run/report.html").read_text("utf-8")


def test_a_document_holds_how_rotations_agree(cli, chain) -> None:
    found = cli.document(f"calibrate {chain} {GYRO} -o a")["calibration"]["ties"]
    assert (found["n_ties"], found["of_mount"], found["dof"]) == (11, False, 33)
    assert found["p_value"] > 0.001
    assert found["error_factor"] < 1.5
    assert cli.document(f"calibrate {chain} -o b")["calibration"]["ties"] is None


@pytest.mark.slow
def test_wrong_errors_of_a_mount_are_found_and_the_remedy_mends_them(cli, tmp_path) -> None:
    rng = np.random.default_rng(22)
    path, times = stare(rng, 12, 5.0, 40.0, 5.0)
    c = campaign(rng, n_frames=12, path=path)
    obs = table(c, time_utc=times[c.columns["frame"]])
    obs.select(np.abs(obs.xy - 511.5).max(axis=1) < 511.0).save(tmp_path / "obs.csv")
    sheet(c).save(tmp_path / "camera.toml")
    words = "run obs.csv camera.toml -o run --directions apparent --mount fixed"
    short = "--steps 40 --walkers 16 --ensembles 2 --mount-sigma-arcsec 1"
    cli.ok(f"{words} {short}", among=(1,))
    checks = json.loads(Path("run/verdict.json").read_text("utf-8"))["checks"]
    (found,) = [check for check in checks if check["name"] == "Known rotations"]
    assert found["level"] == "fail"
    remedy = found["remedy"].split(" or ")[0].split()[1:]
    cli(*remedy)
    checks = json.loads(Path("run/verdict.json").read_text("utf-8"))["checks"]
    (found,) = [check for check in checks if check["name"] == "Known rotations"]
    assert found["level"] == "pass"


def test_what_cannot_be_is_refused_in_one_sentence(cli, chain) -> None:
    for words, said in (
        ("--mount fixed", "--mount fixed needs --mount-sigma-arcsec"),
        ("--mount fixed --mount-sigma-arcsec 1", "no time_utc"),
        ("--mount-sigma-arcsec 1", "needs --mount fixed"),
        ("--relative-attitudes none.csv", "none.csv"),
        ("--relative-alignment-arcsec 5", "needs --relative-attitudes"),
        (f"{GYRO} --effects frame", "--effects"),
        (f"{GYRO} --mount fixed", "--mount fixed"),
        ("--relative-attitudes camera.toml", "camera.toml"),
    ):
        cli.refuses(said, f"calibrate {chain} -o run {words}")
    for words, said in (
        ("--relative-attitudes-arcsec 5 --choose 3", "know no rotations"),
        ("--relative-attitudes-arcsec 5 --mount-sigma-arcsec 5", "exclude each other"),
        ("--relative-alignment-arcsec 5", "needs --relative-attitudes-arcsec"),
    ):
        cli.refuses(said, f"plan camera.toml {words}")


def test_the_real_frames_of_esa_are_not_on_a_fixed_mount(cli, real_data) -> None:
    files = [real_data / f"esa_tetra3_{name}" for name in ("observations.csv", "camera.toml")]
    mount = "-o run --time 2019-07-29T20:47:26 --mount fixed --mount-sigma-arcsec 5"
    cli.refuses("contradicts the stars", "calibrate", *files, *mount.split())


@pytest.mark.slow
def test_a_plan_states_what_rotations_bring(cli, chain) -> None:
    out, _ = cli.ok("plan camera.toml --frames 30 --relative-attitudes-arcsec 5 -o planned")
    words = " ".join(out.split())
    assert "Rotations that are known to 5 arcsec from each frame to the next change" in words
    assert "Rotations that are known to 5 arcsec" in Path("planned/plan.html").read_text("utf-8")
