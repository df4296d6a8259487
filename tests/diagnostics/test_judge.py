"""Draws are judged once: what a posterior says of itself is what verdict."""

import dataclasses
import itertools
import json
import shlex

import numpy as np
import pytest
from rich.console import Console

import starcal_uq as sc
from starcal_uq.cli import console
from starcal_uq.core.records import from_plain, to_plain
from starcal_uq.core.remedy import RUN, SITE, Near, Remedy, calibrated, identified
from starcal_uq.core.status import Check, Code, Level, worst
from starcal_uq.diagnostics.verdict.judge import judge
from starcal_uq.diagnostics.verdict.observed import NOISE, ROBUST, SCREEN
from starcal_uq.diagnostics.verdict.remedies import Place, Tried
from starcal_uq.inference.checks import check_draws
from starcal_uq.presentation.report.page import context
from starcal_uq.presentation.report.results import Results
from tests.helpers.scenes import observations


@pytest.fixture(scope="module")
def short():
    """60 frames, their calibration, and the posterior of a run that is too short to be sure of."""
    obs = observations(n_frames=60)
    cal = sc.calibrate(obs, sc.paper.paper_start())
    return obs, cal, sc.sample(obs, cal, seed=0, n_steps=20)


@pytest.fixture(scope="module")
def disputed(short):
    """Draws that fail a check: an importance estimate far from them."""
    post = short[2]
    changed = dataclasses.replace(
        post, diagnostics=dataclasses.replace(post.diagnostics, agreement_mean=0.9)
    )
    checks = check_draws(changed)
    return dataclasses.replace(
        changed, diagnostics=dataclasses.replace(changed.diagnostics, checks=checks)
    )


def test_every_reader_shows_the_same_checks(short, disputed, monkeypatch, tmp_path):
    obs, cal, _ = short
    assert not disputed.diagnostics.ok and disputed.diagnostics.level.exit_status == 1
    verdict = judge(obs, cal, disputed)
    of_draws = set(verdict.checks) - set(judge(obs, cal).checks)
    assert of_draws >= set(disputed.diagnostics.checks)
    assert disputed.diagnostics.ok == (worst(of_draws) is not Level.FAIL)
    page = context(Results(name="run", observations=obs, calibration=cal, posterior=disputed))
    assert page["verdict"] == verdict
    html = disputed._repr_html_()
    recorded = Console(record=True, width=1000)
    monkeypatch.setattr(console, "out", recorded)
    console.show_posterior(disputed)
    terminal = recorded.export_text()
    for check in disputed.diagnostics.checks:
        assert check.sentence in terminal and check.value in terminal
        assert check.name in html
    disputed.save(tmp_path / "posterior.nc")
    assert (
        sc.Posterior.load(tmp_path / "posterior.nc").diagnostics.checks
        == disputed.diagnostics.checks
    )


def test_posteriors_of_earlier_versions_keep_the_words_of_their_checks(
    disputed, tmp_path, monkeypatch
):
    path = tmp_path / "posterior.nc"

    def without_facts(record, dumps=json.dumps):
        for kept in record.get("diagnostics", {"checks": ()})["checks"]:
            # For readers beside the facts, and all that there was before.
            assert kept["sentence"] and kept["value"] and kept["bound"] and kept["name"]
            kept["sentence"] = f"Long ago: {kept['sentence']}"
            for name in ("values", "bounds", "orders", "told"):
                del kept[name]
        return dumps(record)

    with monkeypatch.context() as patch:
        patch.setattr(json, "dumps", without_facts)
        disputed.save(path)
    old = sc.Posterior.load(path)
    old.save(path, force=True)
    for before, read, again in zip(
        *(one.diagnostics.checks for one in (disputed, old, sc.Posterior.load(path))),
        strict=True,
    ):
        assert read.sentence == f"Long ago: {before.sentence}"
        assert (read.value, read.bound, read.advice) == (before.value, before.bound, before.advice)
        assert again == read and str(again) == str(read)


def test_checks_are_data():
    check = Check(
        Code.R_HAT,
        {"rhat": 1.2, "disagreeing": ("f",), "n_ensembles": 4},
        Level.FAIL,
        {"rhat_below": 1.01},
        (Remedy("sample", (RUN,), form="call"),),
    )
    plain = json.loads(json.dumps(to_plain(check)))
    assert plain["values"] == {"rhat": 1.2, "disagreeing": ["f"], "n_ensembles": 4}
    assert to_plain(from_plain(Check, plain)) == plain
    assert str(check).startswith(
        "fail: R-hat, 1.2000 (asked for: < 1.01). The ensembles disagree in f: raise n_steps "
    )
    assert str(check).endswith("Remedy: sc.sample(obs, cal)")
    assert [level.exit_status for level in Level] == [0, 0, 1]
    assert worst(()) is Level.PASS


def test_numbers_are_judged_with_their_monte_carlo_error(short):
    """Four errors of the comparison beside the difference that would matter, and no more."""
    post = short[2]
    d = post.diagnostics
    slack = 4.0 * np.sqrt(1.0 / np.min(d.ess_bulk) + 1.0 / d.psis_ess)
    for factor, level in ((0.99, Level.PASS), (1.01, Level.FAIL)):
        other = dataclasses.replace(
            post, diagnostics=dataclasses.replace(d, agreement_sd=(0.05 + slack) * factor)
        )
        (check,) = (check for check in check_draws(other) if check.name == "Independent posterior")
        assert check.level is level


def test_what_a_run_was_made_with_is_no_remedy():
    asked = Check(
        Code.EVENNESS_OF_THE_NOISE,
        {"tests": ("uneven",), "p_value": 0.0},
        Level.WARN,
        remedies=NOISE + ROBUST,
    )
    words = ("run", "obs.csv", "camera.toml")
    plain = ("--method", "least_squares")
    found = Place("r", (*words, "--effects", "noise", *plain)).exact(asked)
    # Plain least squares has neither tails nor noise that varies.
    assert (
        found.remedy == ""
        and "made with --effects noise already" in found.advice
        and "--effects tails" in found.advice
    )
    alone = Place("r", (*words, "--effects", "tails", *plain)).exact(asked)
    assert alone.remedy == "" and alone.advice.endswith(
        "the run was made with --effects tails already."
    )
    tried = (Tried({"effects": "auto,noise"}, 1, 0),)
    fresh = Place("r", words, tried=tried).exact(asked)
    assert fresh.remedy == "starcal-uq run obs.csv camera.toml --effects auto,tails -o r --force"
    # What the data chose is held as well.
    held = dataclasses.replace(Place("r", words), held=("tails", "zenith")).exact(asked)
    assert [one.arguments["effects"] for one in held.remedies if one.form != "call"] == ["noise"]
    # Effects are added to those that are given, or that `run` looks for by itself; no option at all
    # is something else.
    for given, wanted in (
        (("--effects", "none"), "noise"),
        (("--effects", "field"), "field,noise"),
        (("--effects", "field,tails"), "field,tails,noise"),
        ((), "auto,noise"),
        (("--likelihood", "pairs"), "noise"),
    ):
        first, *_ = Place("r", (*words, *given)).exact(asked).ways
        found = dict(itertools.pairwise(shlex.split(first[0])))
        assert found["--effects"] == wanted and first[0].count("--effects") == 1
    whole = dataclasses.replace(asked, remedies=calibrated("command"))
    made = Place("r", (*words, "--effects", "noise")).exact(whole)
    assert made.remedy.endswith("--effects noise -o r --force")


def test_runs_of_earlier_versions_are_made_again_with_their_switches_as_effects():
    check = Check(Code.OUTLIERS, level=Level.WARN, remedies=calibrated("command", effects="tails"))
    words = ("run", "obs.csv", "camera.toml", "--noise", "model", "--star-errors", "--screen")
    made = Place("r", words).exact(check)
    assert made.remedy == (
        "starcal-uq run obs.csv camera.toml --effects noise,star,tails --screen -o r --force"
    )
    again = Place("r", (*words, "--robust")).exact(check)
    assert again.remedy == "" and "made with --effects tails already" in again.advice
    even = Place("r", ("run", "obs.csv", "camera.toml", "--noise", "common")).exact(check)
    assert "--noise" not in even.remedy and "--effects auto,tails" in even.remedy


def test_remedies_name_the_files_of_the_run():
    """By the command that made the run where there was one, else by what the run holds."""
    check = Check(Code.OUTLIERS, level=Level.WARN, remedies=SCREEN)
    made = Place(
        "/a b/run", ("run", "/data/obs.csv", "/data/camera.toml", "--effects", "noise")
    ).exact(check)
    assert tuple(words for words, _ in made.ways) == (
        (
            "starcal-uq run /data/obs.csv /data/camera.toml --effects noise --screen -o '/a b/run' "
            "--force"
        ),
        "sc.calibration.screen(obs, camera)",
    )
    steps = Place("/run or that").exact(check)
    files = "'/run or that/observations.parquet' '/run or that/camera.toml' -o '/run or that-2'"
    assert steps.remedies[0].command == f"starcal-uq run {files} --screen --force"
    assert (
        Place("r").of(Remedy("sample", (RUN,), {"force": True, "n_steps": 400})).command
        == "starcal-uq sample r --force --steps 400"
    )
    near = Near(52.2, 7.4)
    (asked,) = identified(site=near)
    images = Place("r", ("run", "/data/images", "--screen")).of(asked).command
    new = "starcal-uq new site --near 52.2 7.4 -o r-site.toml --force"
    assert (
        images == f"{new} && starcal-uq run /data/images --screen --site r-site.toml -o r --force"
    )
    apparent = Place("r", ("run", "obs.csv", "camera.toml", "--directions", "apparent"))
    made = (
        "starcal-uq run obs.csv camera.toml --directions catalogue --site r-site.toml -o r --force"
    )
    (asked,) = calibrated("command", site=near)
    assert apparent.of(asked).command == f"{new} && {made}"
    # Where nothing tells the place, there is no command to copy.
    unknown = dataclasses.replace(check, remedies=calibrated("command", site=SITE))
    assert apparent.exact(unknown).remedy == ""
    # Without stars there is nothing to calibrate on.
    assert (
        Place("r", observations=False)
        .exact(check)
        .remedies[0]
        .command.startswith("starcal-uq calibrate OBS CAMERA -o r")
    )
