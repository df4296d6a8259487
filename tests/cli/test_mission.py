"""budget, compare, plan and the mission's sky of propagate at the command line."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import starcal_uq as sc
from starcal_uq.cli.run import _conclude
from starcal_uq.core.status import Level

REQUIREMENTS = """
[[requirement]]
name = "R-1 impossible"
axis = "cross-boresight"
limit_arcsec = 0.001

[[requirement]]
name = "R-2 generous"
axis = "Z"
limit_arcsec = 1000.0
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with everything but the questions to the model, which take long."""
    run = sc.Run(tmp_path_factory.mktemp("mission") / "run")
    stars = sc.load_catalogue(max_mag=6.0, epoch=2026.9)
    obs = sc.simulate(
        stars, sc.paper.paper_camera(), n_frames=60, min_stars=8, sigma_px=0.05, seed=1
    )
    run.calibrate(obs, sc.paper.paper_start(), force=True)
    run.sample(force=True, n_steps=60, seed=1)
    run.propagate(n_draws=60, seed=1)
    return run.path


@pytest.fixture
def small_plans(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A camera, and plans over fewer attitudes and campaigns, without sweeps: what the options mean
    does not depend on how many there are.
    """
    from starcal_uq.planning import open_distortion, plan

    sc.paper.paper_start().save(tmp_path / "camera.toml")
    less = {"n_geometries": 300, "n_campaigns": 40, "sweeps": False}
    monkeypatch.setattr(sc, "plan", partial(sc.plan, **less))
    choose, check = sc.planning.choose_frames, sc.planning.check_forecast
    monkeypatch.setattr(
        sc.planning, "choose_frames", partial(choose, candidates=300, n_geometries=100)
    )
    monkeypatch.setattr(sc.planning, "check_forecast", partial(check, n_geometries=300))
    for name in ("_SWEEP_GEOMETRIES", "_TRIED_ATTITUDES"):
        monkeypatch.setattr(plan, name, 200)
    monkeypatch.setattr(open_distortion, "_GEOMETRIES", 100)
    monkeypatch.setattr(open_distortion, "_CAMPAIGNS", 20)


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "run"))


def test_budget_in_all_formats(cli, run, tmp_path):
    names = [f"budget.{ending}" for ending in ("csv", "xlsx", "tex", "html")]
    out, _ = cli.ok("budget run " + " ".join(f"-o {name}" for name in names))
    assert "not assessed" in out and "at least" in out
    for name in names:
        assert (tmp_path / name).stat().st_size > 1000
    kept, copy = (sc.budgeting.Budget.load(folder / "budget.csv") for folder in (run, tmp_path))
    pd.testing.assert_frame_equal(kept.to_dataframe(), copy.to_dataframe())
    cli.refuses("exists already", "budget run -o budget.csv")
    cli.refuses(".xlsx", "budget run -o budget.docx")


def test_budget_of_two_heads(cli, run, tmp_path):
    """One sensor twice, with boresights at right angles: the turn about either is known well."""
    (tmp_path / "heads.toml").write_text(
        '[[head]]\nname = "A"\nrotation = [0, 0, 0, 1]\nrun = "run"\n'
        '[[head]]\nname = "B"\nrotation = [0, 1, 0, 1]\nrun = "run"\n'
    )
    cli.refuses("run `starcal-uq budget run`", "budget --heads heads.toml")
    cli("budget run")
    out, _ = cli.ok("budget --heads heads.toml -o array.html -o array.csv")
    assert "B: centroid noise (NEA)" in out
    array, alone = (sc.budgeting.Budget.load(tmp_path / n) for n in ("array.csv", "run/budget.csv"))
    assert array.total("Z").sigma_arcsec < 0.3 * alone.total("Z").sigma_arcsec
    assert "of the body" in (tmp_path / "array.html").read_text()
    assert cli.document("budget --heads heads.toml")["run"] == "heads.toml"
    for words in ("budget", "budget run --heads heads.toml"):
        cli.refuses("--heads FILE", words)
    cli.refuses("to the budget of each", "budget --heads heads.toml --template t.toml")


def test_run_refuses_a_wrong_budget_file_before_any_work(cli, inputs, tmp_path):
    (tmp_path / "wrong.toml").write_text("[[contributor]]\nname = 3\n")
    cli.refuses("wrong.toml", "run inputs/obs.csv inputs/camera.toml -o new --budget wrong.toml")
    assert not (tmp_path / "new").exists()


def test_a_budget_is_a_further_result_whose_requirements_are_checks_of_the_run(cli, run, tmp_path):
    """The line that `--template` prints is followed to the letter, over a budget, a report and a
    verdict.
    """
    cli("budget run")
    # Control: without a requirement that is violated, nothing failed.
    cli.ok("report run")
    before = {path.name for path in run.iterdir()}
    report = (run / "report.html").read_bytes()
    out, _ = cli.ok("budget run --template start.toml")
    following = out.split("Next: starcal-uq ")[1].split()
    cli(*following)
    # The same file again replaces its own budget.
    _, err = cli.ok(*following)
    assert (
        "report.html is older than the budget; run `starcal-uq report run` to make it again" in err
    )
    assert {path.name for path in run.iterdir()} == before
    assert (run / "report.html").read_bytes() == report
    # Another file adds a budget; the verdict knows its requirements at once, the report when it is
    # made again.
    (tmp_path / "mission.toml").write_text(REQUIREMENTS)
    cli.ok("budget run --budget mission.toml", among=(1,))
    assert {path.name for path in run.iterdir()} == before | {"budget-1.csv"}
    stated = sc.budgeting.Budget.load(run / "budget-1.csv").provenance["settings"]["file"]
    assert stated == "start.toml"
    document = json.loads((run / "verdict.json").read_text())
    required = [check for check in document["checks"] if check["question"] == "required"]
    assert {check["name"]: check["level"] for check in required} == {
        "Requirement 'R-1 impossible'": "fail",
        "Requirement 'R-2 generous'": "warning",
    }
    assert document["level"] == "fail" and document["exit_status"] == 1
    assert (run / "report.html").read_bytes() == report
    # As `run` and `demo` end, and as `report` does.
    answer = _conclude(sc.Run(run))
    assert answer.status == 1 and answer.results["verdict"].level is Level.FAIL
    made = (run / "report.html").stat().st_mtime_ns
    out, _ = cli.ok("report run", among=(1,))
    assert (run / "report.html").stat().st_mtime_ns == made
    assert "Verdict (fail): Violated: requirement 'R-1 impossible'." in out
    assert "Reduce 'centroid noise (NEA)', or relax the limit" in " ".join(out.split())
    page = (run / "report.html").read_text("utf-8")
    banner = page[page.index('<div class="verdict') :].split("</header>")[0]
    first_page = page.split('<nav aria-label="Contents"')[0]
    assert banner.startswith('<div class="verdict fail"')
    assert "requirement &#39;R-1 impossible&#39;" in banner
    assert "&#39;R-1 impossible&#39; (across the boresight" in first_page
    assert "relax the limit in the budget file" in first_page
    # What is violated is the mission's: the numbers of the camera stay what they are.
    assert "Not usable" not in answer.results["verdict"].headline
    assert answer.results["verdict"].headline.endswith("Open: requirement 'R-2 generous'.")
    # All of it belongs to the run, and goes with what it rests on.
    record = json.loads((run / "run.json").read_text())
    assert record["files"]["budget-1.csv"]["step"] == "budget"
    assert list(record["steps"])[-1] == "report"


def test_mission_sky_takes_the_place_of_the_observed_frames(cli, run):
    observed = sc.propagation.AttitudeError.load(run / "attitude.csv")
    cli("budget run")
    assert (run / "budget.csv").exists()
    words = "propagate run --attitudes random --max-mag 6.5 --frames 200 --draws 60 --force"
    assert "random attitudes" in cli.document(words)["attitude"]["frames"]
    mission = sc.propagation.AttitudeError.load(run / "attitude.csv")
    # More stars, less noise; and what rested on the old numbers is gone.
    assert mission.nea_arcsec[0] < observed.nea_arcsec[0]
    assert not (run / "budget.csv").exists()


def test_slew_has_a_spectrum(cli, run, tmp_path):
    time = np.arange(0.0, 200.0, 5.0)
    angle = np.radians(0.3 * time)
    q = {"qx": np.sin(angle / 2), "qy": 0.0 * time, "qz": 0.0 * time, "qw": np.cos(angle / 2)}
    pd.DataFrame({"time_s": time, **q}).to_csv(tmp_path / "slew.csv", index=False)
    out, _ = cli.ok("propagate run --attitudes slew.csv --rate 1.0 --draws 60 --force")
    assert "correlat" in out or "frequenc" in out
    spectrum = sc.propagation.ErrorSpectrum.load(run / "error_spectrum.npz")
    integral_arcsec2 = spectrum.psd_arcsec2_hz.sum(axis=0) * spectrum.frequency_hz[0]
    assert integral_arcsec2 == pytest.approx(spectrum.variance_arcsec2, rel=1e-6)
    for wrong in ("none.csv", "run/calibration.json"):
        cli.refuses(Path(wrong).name, f"propagate run --attitudes {wrong} --force")
    cli.refuses("first, last", "propagate run --attitudes slew.csv --scalar middle")


def test_compare_two_runs_and_two_halves(cli, run, tmp_path):
    shutil.copytree(run, tmp_path / "again")
    # Square brackets are no markup.
    out, _ = cli.ok("compare run --split odd-even -o page --labels 'a[/x],b [red]'")
    assert "a[/x] and b [red] agree" in out
    assert (tmp_path / "page" / "comparison.html").exists()
    assert sc.comparison.CameraComparison.load(tmp_path / "page").tested
    # The same data: chance has no part in a difference.
    document = cli.document("compare run again --labels cold,hot")
    assert document["labels"] == ["cold", "hot"]
    assert document["p_map"] is None
    for wrong in ("run", "run again --split odd-even", "run again --labels one"):
        cli.refuses("", f"compare {wrong}")
    cli.refuses("not empty", "compare run again -o page")


def test_plan_before_any_data(cli, run, tmp_path, small_plans, monkeypatch):
    monkeypatch.setitem(sc.plan.keywords, "sweeps", True)
    cal = sc.Calibration.load(run / "calibration.json")
    cal.camera.save(tmp_path / "calibrated.toml")
    words = "plan calibrated.toml --target-arcsec 20 --frames 30 --frames 300"
    # Sixty frames that are there already are sixty fewer to take.
    needs = [
        cli.document(f"{words} --sigma {cal.sigma} {after}")["plan"]["needs"][0]["frames"]
        for after in ("-o plan", "--after run")
    ]
    assert needs[0] - needs[1] == pytest.approx(60, abs=30)
    assert (tmp_path / "plan" / "plan.html").exists()
    assert len(pd.read_csv(tmp_path / "plan" / "plan.csv")) == 2


def test_plan_of_two_heads(cli, tmp_path, small_plans):
    (tmp_path / "heads.toml").write_text(
        '[[head]]\nname = "A"\nrotation = [0, 0, 0, 1]\n'
        '[[head]]\nname = "B"\nrotation = [0, 1, 0, 1]\n'
    )
    words = "plan camera.toml --frames 30 --heads heads.toml"
    found = {row["heads"]: row for row in cli.document(words)["heads"]}
    assert found["A + B"]["z_arcsec"] < 0.2 * found["A"]["z_arcsec"]
    assert found["A"]["z_arcsec"] == pytest.approx(found["B"]["x_arcsec"], rel=1e-6)
    assert "A + B" in cli(words)[1]
    (tmp_path / "heads.toml").write_text("")
    cli.refuses("holds no head", words)


def test_plan_states_what_effects_cost(cli, tmp_path, small_plans):
    words = "plan camera.toml --frames 100 --distortion-percent 0 0 --effects"
    out, _ = cli.ok(f"{words} frame=0.1,temperature --temperature-range 40 -o held")
    assert "What effects cost after" in out
    assert "camera alone" in out and "Over 40 K, slopes with the temperature are known" in out
    table = pd.read_csv(tmp_path / "held" / "effects.csv", index_col="effects")
    assert list(table.index) == ["none", "frame", "temperature", "all"]
    assert table.f_px["frame"] > 1.1 * table.f_px["none"]
    assert 'id="effects"' in (tmp_path / "held" / "plan.html").read_text("utf-8")
    rows = cli.document(f"{words} temperature")["plan"]["effects"]
    assert rows[0]["effects"] == "none" and rows[0]["sigma"]["f_px_per_K"] is None
    # Half the range, twice the sigma of the slope.
    slope = rows[1]["sigma"]["f_px_per_K"]
    assert slope == pytest.approx(2.0 * table.f_px_per_K["temperature"], rel=0.05)
    for wrong, said in (
        ("star", "the effect 'star' cannot be planned"),
        ("epoch --nights 1", "the effect 'epoch' needs at least 2"),
        ("field --choose 5", "--choose and --check plan calibrations without effects"),
    ):
        cli.refuses(said, f"{words} {wrong}")


def test_square_brackets_are_no_markup(cli, run, tmp_path):
    (tmp_path / "b.toml").write_text(REQUIREMENTS.replace("R-1 impossible", "R-1 [/x] rev [b]"))
    out, err = cli.ok("budget run --budget b.toml", among=(1,))
    assert "R-1 [/x] rev [b]" in out and "R-2 generous" in out
    assert "violated: 'R-1 [/x] rev [b]'" in err and "R-2" not in err


def test_a_runs_own_files_are_not_mixed_with_others(cli, run, tmp_path, small_plans):
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    for words in ("compare run --split halves", "plan camera.toml --frames 30"):
        cli.refuses("holds the results of another command", f"{words} -o run --force")
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before
    (tmp_path / "b.toml").touch()
    cli.refuses("write over", "budget run --budget b.toml --template ./b.toml --force")
    cli.refuses("", "compare run --split halves --labels a,a")


def test_plan_after_a_run_of_another_sensor_is_refused(cli, run, tmp_path, small_plans):
    sc.paper.paper_start().replace(width_px=512, height_px=512, x0_px=255.5, y0_px=255.5).save(
        tmp_path / "other.toml"
    )
    cli.refuses("give the file and the run of one sensor", "plan other.toml --after run")
    # A stated noise is not overruled by that of the run.
    found = [
        cli.document(f"plan camera.toml --after run --frames 100 {sigma}")["plan"]["sigma_px"]
        for sigma in ("", "--sigma 0.5")
    ]
    assert found == [pytest.approx(0.05, rel=0.1), 0.5]


def test_plan_refuses_what_it_cannot_mean(cli, run, small_plans):
    for wrong, said in (
        ("--after run --check 10", "--check"),
        ("--max-mag 30", "--max-mag '30': give a number from -2 to 10"),
        ("--sigma 300", "--sigma '300': give a number from 1e-06 to 100"),
    ):
        cli.refuses(said, f"plan camera.toml --frames 30 {wrong}")
    cli.refuses(
        "--max-mag '99': give a number from -2 to 10",
        "propagate run --attitudes random --max-mag 99",
    )
    # What was asked for is in the document.
    words = "plan camera.toml --frames 30 --target-arcsec 1e-9 --choose 3 --check 10"
    document = cli.document(words, among=(1,))
    assert len(document["choice"]["frames"]) == 3
    assert document["check"]["rows"]
    assert "only the rest counts: more than ten million" in document["plan"]["text"]


def test_propagate_tells_what_it_found_odd(cli, run, tmp_path):
    cli("budget run")
    half = np.radians(np.arange(10.0)) / 2
    pointings = {"time_s": np.arange(10.0), "qx": np.sin(half), "qy": 0.0, "qz": 0.0}
    pointings["qw"] = 1.001 * np.cos(half)
    pd.DataFrame(pointings).to_csv(tmp_path / "ten.csv", index=False)
    _, err = cli.ok("propagate run --attitudes ten.csv --draws 60 --force")
    assert "normalised" in err
    assert "too few for a spectrum" in err
    assert (
        "note: budget.csv: removed, because it rested on what is replaced; run `starcal-uq "
        "budget run`"
    ) in err
    assert not (run / "error_spectrum.npz").exists()
    cli.refuses("belong to an attitude profile", "propagate run --rate 2")


def test_a_plan_takes_its_noise_from_a_sensor(cli, tmp_path, small_plans):
    cli.ok("new sensor -o sensor.toml")
    words = {"all": "", "brightest": "--max-stars 12"}
    words["sensor"] = "--max-stars 12 --sensor sensor.toml"
    plans = {name: cli.document(f"plan camera.toml {w}")["plan"] for name, w in words.items()}
    assert plans["brightest"]["mean_stars"] <= 12.0 < plans["all"]["mean_stars"]
    # The brightest stars of a small tracker are located better than to 0.05 px.
    assert plans["sensor"]["sigma_px"] < 0.04
    text = (tmp_path / "sensor.toml").read_text()
    (tmp_path / "baffle.toml").write_text(
        text.replace("sun_exclusion_deg = 0.0", "sun_exclusion_deg = 60.0")
    )
    for wrong, said in (
        ("--time 2026-11-26T12:00:00", "add --sensor, or leave them out"),
        ("--sensor baffle.toml", "baffle.toml: sun_exclusion_deg is 60 and needs --time"),
        ("--sensor sensor.toml --position-km 1,2", "not three numbers in km"),
    ):
        cli.refuses(said, f"plan camera.toml {wrong}")
    checked = cli.document("plan camera.toml --sensor sensor.toml --frames 20 --check 10")
    assert checked["check"]["rows"]
    seen = cli.document("plan camera.toml --sensor baffle.toml --time 2026-11-26T12:00:00")["plan"]
    # The cone of 60 degrees around the Sun is a quarter of the sky.
    share = seen["sky_fraction"] / plans["all"]["sky_fraction"]
    assert share == pytest.approx(0.75, abs=0.1)
