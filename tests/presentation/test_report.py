"""The report of a run: complete, self-contained, honest about what is missing, and written all or
nothing.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
import shlex
import shutil
import signal
import sys
import time
from html.parser import HTMLParser
from multiprocessing import active_children

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core.formatting import significant
from starcal_uq.core.tasks import processors
from starcal_uq.diagnostics.verdict.remedies import Place
from starcal_uq.inference.checks import check_draws
from starcal_uq.presentation.html import symbol
from starcal_uq.presentation.pages import printing
from starcal_uq.presentation.report.drawing import FIGURES, Ahead, draw_figures
from starcal_uq.presentation.report.page import render
from starcal_uq.presentation.report.summary import terminal_summary, verdict_lines
from starcal_uq.presentation.report.tables import parameter_rows
from starcal_uq.presentation.words.propagation import attitude_rows
from starcal_uq.propagation.attitude_error import AttitudeError
from starcal_uq.propagation.onboard_error import EffectError, OnboardError
from tests.helpers.scenes import camera, nominal, observations

VOID = {"meta", "img", "br", "hr", "link", "input"}
SECTIONS = {"parameters", "attitude", "posterior", "coupling", "residuals", "convergence", "checks"}
SECTIONS |= {"misfit", "diagnostics", "method", "provenance"}


class Page(HTMLParser):
    """Ids, links, images and texts of a page; fails on tags that are not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.tags: set[str] = set()
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        if "id" in values:
            self.ids.add(values["id"])
        if tag == "a":
            self.links.append(values["href"])
        if tag == "img":
            self.images.append(values)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """A complete run folder with its report."""
    run = sc.runs.RunFolder(tmp_path_factory.mktemp("report") / "run").create()
    obs = observations(n_frames=60)
    obs.save(run.observations)
    start = sc.paper.paper_start()
    start.save(run.camera)
    cal = sc.calibrate(obs, start)
    cal.save(run.calibration)
    post = sc.sample(obs, cal, seed=1, n_steps=100)
    post.save(run.posterior)
    sc.propagate(post, obs, n_draws=200, seed=1).save(run.attitude)
    sc.propagation.field_map(post, obs, n=9).save(run.field_map)
    sc.Run(run.path).diagnose(n_starts=1)
    assert sc.report(run.path) == run.report
    return run


@pytest.fixture
def run(full, tmp_path):
    """A copy that a test may change."""
    shutil.copytree(full.path, tmp_path / "run")
    return sc.runs.RunFolder(tmp_path / "run")


@pytest.fixture
def unrecorded(run):
    """A copy whose files a test may change, as those of versions without a record of the run."""
    (run.path / "run.json").unlink()
    return run


def page(run) -> Page:
    return Page(run.report.read_text(encoding="utf-8"))


def words(run, truth=None) -> str:
    """The text of the report that a run would give, without drawing its figures."""
    return Page(render(sc.Run(run.path, truth).results, {})).text


def test_every_section_is_there_and_every_link_leads_somewhere(full):
    found = page(full)
    assert found.ids >= SECTIONS
    assert {link.removeprefix("#") for link in found.links} == SECTIONS
    assert len(found.images) == 14
    assert all(image["alt"] for image in found.images)


def test_one_file_without_network(full):
    text = full.report.read_text(encoding="utf-8")
    found = page(full)
    # The interactive figure alone has a script, and it is in the page.
    assert text.count("<script>") == text.count('<div class="explorer">') == 1
    assert "link" not in found.tags and "<script src" not in text
    assert all(image["src"].startswith("data:image/svg+xml,") for image in found.images)
    # Names of kinds of XML are no addresses; within figures a clip is named by its id.
    assert "http" not in re.sub(
        r"""(xmlns(:xlink)?=)?['"]http://www.w3.org/[a-z0-9/]*['"]""", "", text
    )
    assert "url(" not in text.replace("url(%23", "") and "@import" not in text
    assert len(text) < 3_000_000


def test_first_page_decides_and_the_rest_is_folded(full):
    text = full.report.read_text(encoding="utf-8")
    first, rest = text.split("<b>Contents</b>")
    heads = re.findall(r"<dt>(.*?)</dt>", first)
    assert heads == ["Attitude error", "What limits it", "What to do next", "Data"]
    assert first.count("<img") == 3 and "<details" not in first
    assert rest.count('<details class="part"') == len(SECTIONS)
    assert rest.count('<details class="part" open>') == 1
    # Unfolded on paper, where no script runs.
    assert (
        "details::details-content { content-visibility: visible" in text
        and "prefers-color-scheme: dark" in text
    )
    paragraph = rest[rest.index("<blockquote") : rest.index("</blockquote>")]
    assert (
        "emcee" in paragraph and "100 kept steps, seed 1" in paragraph and "starcal_uq" in paragraph
    )


def test_summary_fits_80_columns_and_its_commands_can_be_put_together(full):
    results = sc.Run(full.path).results
    name = "a folder of a name that is long " * 3
    place = Place(f"/data/{name}", ("run", "/data/obs.csv", "/data/camera.toml"))
    obs = results.observations.with_meta(directions="undeclared")
    lines = terminal_summary(dataclasses.replace(results, observations=obs, place=place))
    assert all(len(line) <= 80 for line in lines if "/data/" not in line)
    start = next(i for i, line in enumerate(lines) if line.lstrip().startswith("try: "))
    end = next(i for i in range(start, len(lines)) if not lines[i].endswith("\\"))
    command = "\n".join(lines[start : end + 1]).strip().removeprefix("try: ").replace("\\\n", "")
    words = shlex.split(command)
    assert words[1:4] == ["run", "/data/obs.csv", "/data/camera.toml"] and words[-3:] == [
        "-o",
        f"/data/{name}",
        "--force",
    ]
    # A list of three commands at most, and a verdict of two lines.
    assert sum(line.lstrip().startswith("try: ") for line in lines) <= 3
    assert len(verdict_lines(results.verdict)) <= 2


def test_without_a_browser_a_pdf_takes_one_sentence(run, unpainted, monkeypatch, tmp_path):
    made = sc.report(run.path)
    monkeypatch.setattr(printing, "browsers", lambda: iter(()))
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(sc.errors.MissingExtraError):
        sc.report(run.path, format="pdf")
    broken, good = tmp_path / "broken", tmp_path / "good"
    broken.write_text("#!/bin/sh\nexit 3\n")
    good.write_text(
        '#!/bin/sh\nfor a; do case "$a" in --print-to-pdf=*) echo %PDF > "${a#*=}";; esac; done\n'
    )
    for script in (broken, good):
        script.chmod(0o755)
    monkeypatch.setattr(printing, "browsers", lambda: iter([str(broken)]))
    with pytest.raises(sc.errors.RunFolderError, match=r"broken made no PDF \(exit status 3\)"):
        sc.report(run.path, format="pdf")
    # The next one is asked; what is there is kept, and goes with the report that it shows.
    monkeypatch.setattr(printing, "browsers", lambda: iter([str(broken), str(good)]))
    assert sc.report(run.path, format="pdf").read_bytes() == b"%PDF\n" and made.exists()
    sc.Run(run.path).report(force=True)
    assert not run.pdf.exists()


def test_figures_are_files_too(full):
    for name in ("corner", "residuals"):
        assert (full.figures / f"{name}.svg").stat().st_size > 20_000, "figures are painted"
    names = {path.stem for path in full.figures.glob("*.svg")}
    assert names == {
        "attitude",
        "convergence",
        "corner",
        "correlation",
        "distortion_curve",
        "field_map",
        "glance_attitude",
        "glance_field",
        "glance_residuals",
        "misfit",
        "price_of_coupling",
        "prior_posterior",
        "residual_profiles",
        "residuals",
    }


def test_verdict_comes_first_in_words(full):
    text = page(full).text
    assert (
        text.index("every check passed")
        < text.index("stars in 60 frames")
        < text.index("95 % interval")
    )
    assert "What limits it" in text and re.search(r"\d+ passed of \d+", text)


def test_parameters_are_those_of_the_posterior(full):
    results = sc.Run(full.path).results
    rows = parameter_rows(results)
    assert len(rows) == 7
    post = results.posterior
    assert [
        float(row["estimate"].replace("−", "-")) for row in rows if row["unit"] != "mm"
    ] == pytest.approx(post.draws.mean(axis=0) / np.array([1, 1, 1, 1e-10, 1e-15, 1]), abs=0.5)
    focal = rows[3]
    assert float(focal["estimate"]) == pytest.approx(results.posterior.mean[2] * 0.012, abs=1e-3)
    assert focal["truth"] == "70.2262"
    low, high = (float(end) for end in rows[0]["interval"].split(" … "))
    assert low < float(rows[0]["estimate"]) < high
    z = (post.mean[0] - 500.0) / post.sd[0]
    assert float(rows[0]["z"].replace("−", "-")) == pytest.approx(z, abs=0.051)
    assert all(row["prior"] for row in rows)


def test_attitude_table(full):
    error = sc.Run(full.path).results.attitude
    rows = attitude_rows(error)
    assert [row["absorbed"] for row in rows] == ["no", "yes", "no", "in part", "no"]
    # Noise is what it is, and stands once.
    assert [figure["name"] for figure in rows[0]["figures"]] == ["both"]
    held = [row["figures"][-1] for row in rows]
    assert all(len(row[group]) == 4 for row in held for group in ("sigma", "p95", "p997"))
    assert float(held[1]["sigma"][0]) == pytest.approx(error.common_arcsec[0], rel=0.05)


def test_without_posterior_the_report_says_which_command_makes_it(run, unpainted):
    for path in (run.posterior, run.attitude, run.field_map):
        path.unlink()
    sc.Run(run.path).report(force=True)
    found = page(run)
    assert f"starcal-uq sample {run.path}" in found.text
    assert f"starcal-uq propagate {run.path}" in found.text
    assert found.ids >= {
        "parameters",
        "coupling",
        "residuals",
        "convergence",
        "checks",
        "method",
        "provenance",
    }
    assert not found.ids & {"attitude", "posterior", "diagnostics"}
    assert {link.removeprefix("#") for link in found.links} <= found.ids
    assert "not been sampled" in found.text


def test_misfit_section_shows_tests_jackknife_models_and_replicates(full):
    text = page(full).text
    section = text[text.rindex("Model error is in no posterior") : text.index("Fig. 3 of Ye")]
    for words_of in (
        "Error with the pixel phase in x",
        "None of the 19 tests found any (overall p",
        "Jackknife over frames",
        "No other model predicts left-out frames better than 'brown'",
        "brown (this report)",
        "rejected",
        "excess kurtosis",
    ):
        assert words_of in section, words_of
    assert "Focal length" in text and "Common rotation, yaw" in text


def test_without_diagnosis_or_with_that_of_another_estimate_the_command_is_named(unrecorded):
    text = unrecorded.diagnosis.read_text(encoding="utf-8")
    unrecorded.diagnosis.write_text(
        text.replace('"theta": [\n  5', '"theta": [\n  6'), encoding="utf-8"
    )
    for _ in range(2):
        found = words(unrecorded)
        assert f"starcal-uq diagnose {unrecorded.path}" in found
        assert "Jackknife over frames" not in found
        unrecorded.diagnosis.unlink(missing_ok=True)


def test_undeclared_directions_are_warned_of_before_any_table(unrecorded):
    obs = sc.load_observations(unrecorded.observations)
    obs.with_meta(directions="undeclared").save(unrecorded.observations, force=True)
    text = words(unrecorded)
    assert text.index("Neither time nor observer velocity was declared") < text.index(
        "95 % interval"
    )
    assert "not declared as apparent" in text


def test_without_truth_there_is_no_truth(unrecorded):
    obs = sc.load_observations(unrecorded.observations)
    meta = {name: value for name, value in obs.meta.items() if name != "truth"}
    dataclasses.replace(obs, meta=meta).save(unrecorded.observations, force=True)
    assert "Truth" not in words(unrecorded)
    assert "Truth" in words(unrecorded, camera())
    # A truth of another distortion model cannot be compared parameter by parameter.
    assert "Truth" not in words(unrecorded, camera("brown3"))


def test_names_from_outside_are_text_and_not_markup(full):
    results = sc.Run(full.path).results
    name = "<script>alert(1)</script> & co"
    nominal_camera = results.calibration.nominal.replace(name=name)
    cal = dataclasses.replace(results.calibration, nominal=nominal_camera)
    text = render(dataclasses.replace(results, calibration=cal, truth=None), {})
    assert "<script>alert" not in text
    assert "&lt;script&gt;" in text
    assert str(symbol("<b>")) == "&lt;b&gt;"


def test_a_report_that_fails_leaves_the_old_one(run, monkeypatch):
    before = run.report.read_bytes()
    figures = {path: path.stat().st_mtime_ns for path in run.figures.iterdir()}
    monkeypatch.setattr(
        "starcal_uq.presentation.report.drawing.draw_figures", lambda *_: {"corner": b"new"}
    )
    monkeypatch.setattr("starcal_uq.presentation.report.page.prepared", lambda *_: lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        sc.Run(run.path).report(force=True)
    assert run.report.read_bytes() == before
    assert {path: path.stat().st_mtime_ns for path in run.figures.iterdir()} == figures


def test_figures_drawn_ahead_by_another_process_are_the_same(full):
    results = sc.Run(full.path).results
    names = ("distortion_curve", "price_of_coupling")
    with Ahead() as ahead:
        ahead.draw(dataclasses.replace(results, coupling=None), names)
        ahead.draw(results, names[1:])
        drawn = ahead.figures()
    if processors() > 1:
        assert drawn == draw_figures(results, names)
    assert {path.stem for path in full.figures.iterdir()} <= set(FIGURES)


def _until(path):
    while not path.exists():
        time.sleep(0.01)


def test_this_process_draws_what_the_other_has_not_begun_while_it_waits(
    full, monkeypatch, tmp_path
):
    monkeypatch.setattr("starcal_uq.core.tasks.processors", lambda: 2)
    monkeypatch.setattr("starcal_uq.presentation.report.drawing._WORTH_LOADING", 1)
    results, here = sc.Run(full.path).results, []
    names = ("distortion_curve", "price_of_coupling")
    drawn = draw_figures(results, names)

    def draw(_, asked):
        here.extend(asked)
        if len(here) == 2:
            (tmp_path / "end").touch()
        return {name: drawn[name] for name in asked}

    with Ahead() as ahead:
        waits = ahead.begin(_until, tmp_path / "end")
        ahead.draw(results, names)
        monkeypatch.setattr("starcal_uq.presentation.report.drawing.draw_figures", draw)
        waits()
        assert here == [*reversed(names)]
        # Nothing is drawn twice.
        assert (ahead.figures(), len(here)) == (drawn, 2)


def test_another_process_that_fails_or_is_killed_is_no_obstacle(monkeypatch):
    monkeypatch.setattr("starcal_uq.core.tasks.processors", lambda: 2)
    with pytest.raises(ZeroDivisionError), Ahead() as ahead:
        failed, after, there = (
            ahead.begin(math.factorial, n) if n else ahead.begin(os.getpid) for n in (-1, 4, 0)
        )
        process = there()
        assert (failed(), after()) == (None, 24) and process != os.getpid()
        os.kill(process, signal.SIGTERM)
        while ahead.begin(math.factorial, 5)() is not None:
            time.sleep(0.01)
        assert ahead.figures() == {}
        1 / 0  # noqa: B018
    assert process not in [child.pid for child in active_children()]
    monkeypatch.setattr("starcal_uq.core.tasks.processors", lambda: 1)
    with Ahead() as ahead:
        assert ahead.begin(math.factorial, 5)() is None


def test_a_report_takes_figures_that_are_drawn(run, monkeypatch):
    asked = []
    ahead = (run.figures / "convergence.svg").read_bytes()
    monkeypatch.setattr(
        "starcal_uq.presentation.report.drawing.draw_figures",
        lambda _, names, *rest: asked.extend(names) or {},
    )
    sc.Run(run.path).report(lambda: {"corner": ahead}, force=True)
    assert sorted([*asked, "corner"]) == sorted(FIGURES)
    assert (run.figures / "corner.svg").read_bytes() == ahead


def test_no_calibration_no_report(tmp_path):
    with pytest.raises(sc.errors.RunFolderError):
        sc.report(sc.runs.RunFolder(tmp_path / "empty").create().path)
    with pytest.raises(TypeError, match="copy that file"):
        sc.report(tmp_path / "empty", tmp_path / "page.html")


@pytest.mark.parametrize("model", ["none", "brown_tangential"])
def test_every_model_and_a_given_noise(model, tmp_path):
    """Nothing is written for five parameters: without coefficients, and with four."""
    truth = camera(model)
    obs = observations(model, n_frames=60)
    run = sc.runs.RunFolder(tmp_path / "run").create()
    obs.save(run.observations)
    cal = sc.calibrate(obs, nominal(truth))
    cal.save(run.calibration)
    sc.sample(obs, cal, seed=1, n_steps=20, n_ensembles=2, sigma=0.05).save(run.posterior)
    text = words(run)
    assert f"Distortion model “{model}”" in text
    assert "was given as 0.05" in text
    assert len(parameter_rows(sc.Run(run.path).results)) == len(cal.theta) + 2


def both_figures(error) -> dict[str, list[str]]:
    """What every place must say of the rest of the calibration, pitch, yaw and roll, by its two
    names.
    """
    return {
        "with the misfit found": [
            significant(float(v)) for v in error.with_misfit_found_arcsec[2, :3]
        ],
        "if the model holds": [significant(float(v)) for v in error.if_model_holds_arcsec[2, :3]],
    }


def stated_everywhere(run, capsys) -> dict[str, dict[str, list[str]]]:
    """The same from every place of a run that states it, by place."""
    import csv

    from starcal_uq.cli.console import out, show_attitude
    from starcal_uq.cli.schemas import document
    from starcal_uq.presentation.words.budgeting import contributors_table

    opened = sc.Run(run.path)
    names = {
        "with the misfit found": "with_misfit_found_arcsec",
        "if the model holds": "if_model_holds_arcsec",
    }

    def of_rows(rows, contributor: str) -> dict[str, list[str]]:
        mine = {
            row["axis"]: row
            for row in rows
            if contributor in (row.get("contributor"), row.get("name"))
        }
        return {
            name: [significant(float(mine[axis][column])) for axis in ("pitch", "yaw", "roll")]
            for name, column in names.items()
        }

    def of_text(text: str) -> dict[str, list[str]]:
        after = text[text.lower().index("calibration, rest") :]
        return {
            name: re.findall(r"[0-9.]+(?:×10\S+)?", after[after.index(name) + len(name) :])[:3]
            for name in names
        }

    rest, found = "calibration, rest", {}
    with open(run.attitude, encoding="utf-8") as file:
        found["attitude.csv"] = of_rows(list(csv.DictReader(file)), rest)
    with open(run.budget, encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["record"] == "contributor"]
        found["budget.csv"] = of_rows(rows, rest)
        counted = [significant(float(row["sigma_arcsec"])) for row in rows if row["name"] == rest]
        assert counted == found["budget.csv"]["with the misfit found"]
    results = {"run": run.path, "attitude": opened.attitude, "spectrum": None}
    found["JSON"] = of_rows(document("propagate", results, 0)["attitude"]["contributors"], rest)
    results = {"run": run.path, "files": [], "template": None, "budget": opened.error_budget}
    found["JSON of the budget"] = of_rows(
        document("budget", results, 0)["budget"]["contributors"], rest
    )
    out.width = 150
    show_attitude(opened.attitude)
    found["terminal"] = of_text(capsys.readouterr().out)
    html = Page(render(opened.results, {})).text
    found["report, attitude"] = of_text(html[html.index("Contribution pitch") :])
    budget = html[html.index("Contributors Standard") :].lower()
    found["report, budget"] = of_text(budget)
    found["notebook"] = of_text(Page(opened.attitude._repr_html_()).text)
    found["notebook, budget"] = of_text(Page(opened.error_budget._repr_html_()).text.lower())
    cells = contributors_table(opened.error_budget).rows
    place = next(i for i, row in enumerate(cells) if row[0] == rest)
    found["terminal, budget"] = {
        row[0].strip(): list(row[2:5]) for row in cells[place + 1 : place + 3]
    }
    bars = [text.get_text().removesuffix("″") for text in opened.attitude.plot.contributors().texts]
    figure = {
        "with the misfit found": bars[6:9],
        "if the model holds": both_figures(opened.attitude)["if the model holds"],
    }
    found["figure"] = figure
    # The card and the sentences say it across the boresight.
    across = (
        opened.attitude.with_misfit_found_arcsec[2, 3],
        opened.attitude.if_model_holds_arcsec[2, 3],
    )
    both = [significant(float(value)) for value in across]
    words = f"{both[0]} arcsec with the misfit found ({both[1]} if the model"
    assert html.count(words) == 1 and words in opened.attitude.text
    assert html.count(f"{both[0]} ({both[1]}) arcsec per axis across the boresight") == 1
    return found


@pytest.mark.usefixtures("unpainted")
def test_every_place_shows_the_same_two_figures_under_the_same_two_names(unrecorded, capsys):
    error = AttitudeError.load(unrecorded.attitude)
    parts = (
        np.hypot(1.3 * error.common_arcsec, [0.7, 0.3, 0.02]),
        np.hypot(1.3 * error.rest_arcsec, [0.52, 0.41, 7.3]),
    )
    effects = (EffectError("field", *parts),)
    found = OnboardError("model", *parts, np.hypot(*parts), effects)
    error = dataclasses.replace(error, misfit=found)
    error.save(unrecorded.attitude)
    sc.Run(unrecorded.path).budget()
    wanted = both_figures(error)
    assert wanted["with the misfit found"] != wanted["if the model holds"]
    places = stated_everywhere(unrecorded, capsys)
    assert len(places) == 11
    assert {place: figures for place, figures in places.items() if figures != wanted} == {}
    # Control: one source that has its own idea is noticed.
    other = dataclasses.replace(
        error, misfit=dataclasses.replace(found, rest_arcsec=2.0 * found.rest_arcsec)
    )
    forget = (unrecorded.path / "run.json").unlink
    forget()
    other.save(unrecorded.attitude)
    differing = {
        place
        for place, figures in stated_everywhere(unrecorded, capsys).items()
        if figures != wanted
    }
    assert "attitude.csv" in differing and "budget.csv" not in differing
    # Never equal to the first by silence.
    forget(missing_ok=True)
    dataclasses.replace(error, misfit=None).save(unrecorded.attitude)
    sc.Run(unrecorded.path).budget(force=True)
    opened = sc.Run(unrecorded.path)
    for text in (
        unrecorded.attitude.read_text(encoding="utf-8"),
        opened.attitude._repr_html_(),
        opened.error_budget._repr_html_(),
        render(opened.results, {}),
    ):
        assert "not assessed" in text
    assert np.isnan(opened.attitude.with_misfit_found_arcsec).all()
    assert all(np.isnan(row.with_misfit_found_arcsec) for row in opened.error_budget.rows)
    assert "misfit of the camera model" in opened.error_budget.not_assessed


def test_a_red_first_page_tells_one_cause_once_and_what_to_do_next(full):
    results = sc.Run(full.path).results
    diagnostics = dataclasses.replace(results.posterior.diagnostics, rhat=np.full(6, 1.2))
    post = dataclasses.replace(results.posterior, diagnostics=diagnostics)
    checks = check_draws(post)
    post = dataclasses.replace(post, diagnostics=dataclasses.replace(diagnostics, checks=checks))
    results = dataclasses.replace(results, posterior=post)
    text = render(results, {})
    assert 'class="verdict fail"' in text
    assert "Not usable, because R-hat failed." in Page(text).text
    first, rest = text.split("<b>Contents</b>")
    heads = re.findall(r"<dt>(.*?)</dt>", first)
    assert heads == ["Cause", "Attitude error", "What to do next", "Data"]
    facts = first[first.index("<dl") :]
    assert facts.count("The ensembles disagree") == 1 and "Not to be used" in facts
    assert 1 <= facts.count("<li><code>starcal-uq ") <= 3
    assert "What else limits the result" in rest
    table = rest[rest.index('<table class="checks">') :]
    found = re.findall(r'<tr><td class="key">.*?<span class="badge (\w+)', table)
    assert found[0] == "fail" and found == sorted(found, key=["fail", "warning", "pass"].index)
    lines = [*terminal_summary(results), "Report: report.html", *verdict_lines(results.verdict)]
    assert len(lines) <= 24 and sum("disagree" in line for line in lines) == 1


@pytest.mark.parametrize("times", [0, 1])
def test_no_number_of_a_table_is_cut_off_or_broken_by_the_terminal(monkeypatch, capsys, times):
    from rich.console import Console

    from starcal_uq.cli import console
    from starcal_uq.presentation.tables import TextTable

    heads = (
        "quantity",
        "unit",
        "coverage 95",
        "coverage low",
        "coverage high",
        "coverage p",
        "rank p",
    )
    row = ("log_likelihood", "arcsec", "0.945", "0.904", "0.972", "0.744", "0.0231")
    monkeypatch.setattr(console, "out", Console(width=80))
    table = TextTable(
        heads + times * heads[2:], (row + times * row[2:],), align="ll" + "r" * 5 * (times + 1)
    )
    console.print_table(table)
    assert set(row) <= set(capsys.readouterr().out.split())


@pytest.mark.usefixtures("unpainted")
def test_figures_of_a_report_do_not_appear_below_the_cell_of_a_notebook(monkeypatch, full):
    from matplotlib import pyplot

    monkeypatch.setattr("starcal_uq.presentation.figures.style._in_notebook", lambda: True)
    assert draw_figures(sc.Run(full.path).results, ["attitude", "glance_attitude"])
    assert pyplot.get_fignums() == []


def test_part_of_a_table_takes_the_first_of_two_columns_of_one_name():
    from starcal_uq.presentation.tables import TextTable

    whole = TextTable(("Name", "z", "Best", "z"), (("f", "1", "a", "2"),), align="lrlr")
    part = whole.part(("z", "Name"), "Two columns")
    assert part == TextTable(("z", "Name"), (("1", "f"),), "Two columns", "rl")
