"""The gallery: every figure of every result, with the code that draws it.

`conf.py` runs the code and writes the page at every build; a test compares the list with the views.
"""

from __future__ import annotations

from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

THUMBNAIL_PX = 260


@dataclass(frozen=True)
class Scene:
    """Code that makes some results, and their figures by class and method: name, question, code."""

    title: str
    words: str
    code: str
    figures: dict[str, tuple[str, str, str]]
    drawn: bool = True


SCENES = (
    Scene(
        "A calibration",
        "One simulated campaign, calibrated and sampled.",
        """\
import starcal_uq as sc

truth = sc.paper.paper_camera()
stars = sc.load_catalogue(max_mag=6.0)
obs = sc.simulate(stars, truth, n_frames=60, min_stars=8, sigma_px=0.05, seed=3)
camera = sc.paper.paper_start()
cal = sc.calibrate(obs, camera)
post = sc.sample(obs, cal, seed=1)""",
        {
            "Posterior.corner": (
                "Posterior, pair by pair",
                "Which values are plausible, pair by pair?",
                "post.plot.corner(cal, truth)",
            ),
            "Posterior.prior_posterior": (
                "Prior and posterior",
                "What did the data add to the prior?",
                "post.plot.prior_posterior(truth)",
            ),
            "Calibration.convergence": (
                "Convergence of the stages",
                "How did the three stages converge?",
                "cal.plot.convergence(truth)",
            ),
            "Calibration.residuals": (
                "Residuals",
                "What remains, and is it noise?",
                "cal.plot.residuals(obs)",
            ),
            "Coupling.correlation": (
                "Parameter correlations",
                "Which parameters trade against each other?",
                "sc.coupling(post).plot.correlation()",
            ),
            "Coupling.correlations": (
                "Correlations with attitude",
                "Which parameters trade against attitude?",
                "sc.coupling(post).plot.correlations()",
            ),
            "Coupling.couplings": (
                "Cost of coupling",
                "What does it cost not to know the other parameters?",
                "sc.coupling(post).plot.couplings()",
            ),
        },
    ),
    Scene(
        "Effects beyond the camera",
        "Real pictures of the sky, taken at an unknown site ([effects](explanation/effects.md)).",
        """\
esa = sc.example_data("esa")
table = sc.sky.make_apparent(esa.observations)
held = "noise,zenith,field,phase,magnitude"
lens = sc.calibrate(table, esa.camera, effects=held)""",
        {
            "Calibration.effects": (
                "Effects",
                "What does each effect do?",
                "lens.plot.effects(table, site=esa.site)",
            ),
            "Effects.scales": (
                "Sizes of effects",
                "How large are the effects?",
                "lens.effects.plot.scales()",
            ),
        },
    ),
    Scene(
        "Attitude and budget",
        "From the posterior to directions, attitudes and a budget.",
        """\
from starcal_uq.budgeting.file import Requirement

error = sc.propagate(post, obs)
need = Requirement("R-1", "cross-boresight", 60.0, 0.997)
budget = sc.budget(post, obs, error, file=sc.budgeting.BudgetFile(requirements=(need,)))""",
        {
            "AttitudeError.contributors": (
                "Attitude error by part",
                "What does each part do to the attitude?",
                "error.plot.contributors()",
            ),
            "Budget.contributors": (
                "Error budget",
                "Which contributors use up the budget?",
                "budget.plot.contributors()",
            ),
            "FieldMap.maps": (
                "Direction error over the detector",
                "Where on the detector is the error large?",
                "sc.propagation.field_map(post, obs).plot.maps()",
            ),
            "DistortionCurve.curve": (
                "Distortion curve",
                "How well is the distortion known, star by star?",
                "sc.propagation.distortion_curve(post, obs).plot.curve()",
            ),
        },
    ),
    Scene(
        "An orbit's temperatures",
        "A camera whose focal length follows temperature, over an orbit of ninety minutes.",
        """\
import dataclasses

import numpy as np

warmth = np.random.default_rng(4).uniform(-20.0, 20.0, obs.n_frames)[obs.frame]
grown = 1.0 + 5e-6 * warmth
warm = dataclasses.replace(
    obs,
    x_px=truth.x0_px + grown * (obs.x_px - truth.x0_px),
    y_px=truth.y0_px + grown * (obs.y_px - truth.y0_px),
    temperature_c=warmth,
)
followed = sc.calibrate(warm, camera, effects="temperature")
t_s = np.linspace(0.0, 5400.0, 91)
orbit = sc.propagation.TemperatureProfile(t_s, 5.0 + 25.0 * np.sin(2.0 * np.pi * t_s / 5400.0))
warmed = sc.propagate(sc.sample(warm, followed, seed=1), warm, temperature_profile=orbit)""",
        {
            "ThermalError.profile": (
                "Error over an orbit's temperatures",
                "What does the temperature do over an orbit?",
                "warmed.thermal.plot.profile()",
            ),
        },
    ),
    Scene(
        "A slew",
        (
            "Calibration errors change as stars move over the detector: along a slew they become a "
            "spectrum."
        ),
        """\
import numpy as np
from scipy.spatial.transform import Rotation

t_s = np.arange(300.0)
turns = Rotation.from_rotvec(np.radians(0.1) * t_s[:, None] * [0.0, 1.0, 0.0]).as_quat()
profile = sc.attitude.AttitudeProfile(t_s, turns)
slew = sc.simulation.profile_frames(stars, truth, profile)
spectrum = sc.propagation.error_spectrum(post, slew, n_draws=20)""",
        {
            "ErrorSpectrum.spectrum": (
                "Error spectrum of a slew",
                "At which frequencies is the error?",
                "spectrum.plot.spectrum()",
            ),
            "ErrorSpectrum.time_series": (
                "Error along a slew",
                "When is the error large?",
                "spectrum.plot.time_series()",
            ),
        },
    ),
    Scene(
        "Diagnosis",
        "Are the model and the intervals right, and do two calibrations agree?",
        """\
diagnosis = sc.diagnose(obs, cal, models=("none", "k1", "brown", "brown3"), n_starts=0)
validation = sc.validate(camera, n_replicates=24, n_frames=20, workers=0)
halves = sc.comparison.compare_halves(obs, camera)""",
        {
            "Diagnosis.diagnosis": (
                "All misfit tests",
                "Is there evidence against the model?",
                "diagnosis.plot.diagnosis()",
            ),
            "Misfit.p_values": (
                "p-values of the tests",
                "Which test found it?",
                "diagnosis.misfit.plot.p_values()",
            ),
            "Jackknife.ratios": (
                "Jackknife over frames",
                "Are frames independent?",
                "diagnosis.jackknife.plot.ratios()",
            ),
            "ModelComparison.models": (
                "Distortion models compared",
                "Would another model predict better?",
                "diagnosis.comparison.plot.models()",
            ),
            "Validation.ranks": (
                "Rank histograms",
                "Are the intervals right for this sensor?",
                "validation.plot.ranks()",
            ),
            "CameraComparison.difference": (
                "Two calibrations compared",
                "Do two halves of the data agree?",
                "halves.plot.difference()",
            ),
        },
    ),
    Scene(
        "Plans",
        "What a calibration will achieve, before any data.",
        """\
plan = sc.plan(camera, stars, target_arcsec=20.0, n_geometries=300, n_campaigns=40)
choice = sc.planning.choose_frames(camera, stars, n_frames=8, candidates=500, n_geometries=200)
check = sc.planning.check_forecast(
    camera, stars, n_frames=(10, 30), n_campaigns=10, n_geometries=300, workers=0
)""",
        {
            "Plan.forecast": (
                "Frames needed",
                "How many frames does the target take?",
                "plan.plot.forecast()",
            ),
            "Plan.sweeps": ("What else would help", "What else would help?", "plan.plot.sweeps()"),
            "FrameChoice.choice": (
                "Best frames to take",
                "Which frames are worth most?",
                "choice.plot.choice()",
            ),
            "ForecastCheck.check": (
                "Forecast against simulation",
                "Is the forecast right?",
                "check.plot.check()",
            ),
        },
    ),
    Scene(
        "Coupling studies",
        ("Couplings over fields, frames, stars and models ([studies](explanation/studies.md))."),
        """\
sc.studies.write_study_template("frames-stars", "study.toml")
study = sc.study("study.toml", workers=0)
with open("simulated.toml", "w") as file:
    file.write('''
    study = {mode = "simulate", seeds = 6}
    observation = {min_stars = 8, max_mag = 6.0, sigma_px = 0.05}
    sweep = {frames = [10, 20]}

    [camera]
    width_px = 1024
    height_px = 1024
    pixel_um = 12.0
    focal_mm = 70.2
    x0_px = 511.5
    y0_px = 511.5
    distortion = "k1"
    k1 = 2e-9
    ''')
simulated = sc.study("simulated.toml", workers=0)""",
        {
            "Study.maps": ("Two axes at a glance", "What do two axes do?", "study.plot.maps()"),
            "Study.map": (
                "One quantity over two axes",
                "How does one quantity vary over both axes?",
                'study.plot.map("frame_error_arcsec")',
            ),
            "Study.correlation": (
                "Correlation along the axes",
                "Does anything decouple the pairs?",
                "study.plot.correlation()",
            ),
            "Study.matrices": (
                "Correlation matrix of each cell",
                "What are all correlations, cell by cell?",
                "study.plot.matrices()",
            ),
            "Study.weakest": (
                "Weakest direction",
                "Which combination is determined worst?",
                "study.plot.weakest()",
            ),
            "Study.inflation": (
                "Sigma, others known or unknown",
                "How large is each sigma, with the others unknown and known?",
                "study.plot.inflation()",
            ),
            "Study.needed": (
                "Frames for a target",
                "How many frames for a target?",
                "study.plot.needed()",
            ),
            "Study.simpler": (
                "Simpler models",
                "Would a simpler model suffice?",
                "study.plot.simpler()",
            ),
            "Study.coverage": (
                "Coverage of simulated intervals",
                "Do simulated intervals contain the truth?",
                "simulated.plot.coverage()",
            ),
        },
    ),
    Scene(
        "Ye & Yang (2017) reproduced",
        (
            "The paper's experiments, here with fewer repetitions than [the page on "
            "it](explanation/paper.md)."
        ),
        """\
paper = sc.paper.reproduce("paper", n_replicates=8, n_frames=50, study=False, workers=0)
sizes = {"fields_deg": (7.0, 15.0), "frames": (12, 48), "max_mags": (5.5, 6.5)}
sizes |= {"n_replicates": 3, "n_frames": 12}
bias = sc.paper.interaction_study(distortion_scales=(0.0, 0.1, 1.0, 10.0), workers=0, **sizes)""",
        {
            "Reproduction.trajectories": (
                "Paper: convergence",
                "How do the stages of the paper converge (its figure 3)?",
                "paper.plot.trajectories()",
            ),
            "Reproduction.error_fields": (
                "Paper: error maps",
                "Where are the errors of each method?",
                "paper.plot.error_fields()",
            ),
            "Reproduction.printed_numbers": (
                "Paper: printed numbers",
                "Do we reproduce the paper's numbers?",
                "paper.plot.printed_numbers()",
            ),
            "Replicates.spread": (
                "Paper: methods compared",
                "How accurate is each method?",
                "paper.replicates.plot.spread()",
            ),
            "InteractionStudy.bias": (
                "Paper: bias by distortion",
                "When does distortion bias the optics?",
                "bias.plot.bias()",
            ),
        },
    ),
    Scene(
        "Field experiment of Ye & Yang",
        (
            "Not drawn here, because it renders and identifies hundreds of images: `starcal-uq "
            "reproduce-field -o field`."
        ),
        """\
from starcal_uq.paper.field.experiment import field_experiment

night = field_experiment("field")""",
        {
            "FieldExperiment.rates": (
                "Paper: identification rate",
                "How many frames are identified?",
                "night.plot.rates()",
            ),
            "FieldExperiment.errors": (
                "Paper: field errors",
                "How large are the errors?",
                "night.plot.errors()",
            ),
        },
        drawn=False,
    ),
)


def _anchor(key: str) -> str:
    return key.lower().replace(".", "-").replace("_", "-")


def _code(text: str) -> str:
    return f"```python\n{text}\n```\n"


def write(page: Path, folder: Path) -> float:
    """Draw everything into a folder, write the page, and return the processor time, s."""
    import io

    from PIL import Image

    from starcal_uq.presentation.figures.style import figure_of, png_bytes

    started = process_time()
    folder.mkdir(parents=True, exist_ok=True)
    names: dict[str, Any] = {}
    thumbnails: list[str] = []
    sections: list[str] = []
    for scene in SCENES:
        sections.append(f"## {scene.title}\n\n{scene.words}\n\n{_code(scene.code)}")
        if scene.drawn:
            exec(scene.code, names)
        for key, (name, question, code) in scene.figures.items():
            sections.append(f"({_anchor(key)})=\n### {question}\n")
            if scene.drawn:
                data = png_bytes(figure_of(eval(code, names)), dpi=110)
                (folder / f"{_anchor(key)}.png").write_bytes(data)
                small = Image.open(io.BytesIO(data)).convert("RGB")
                small.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
                small.save(folder / f"{_anchor(key)}-small.png", optimize=True)
                alt = f"{name}. {question}"
                where = f"{folder.name}/{_anchor(key)}"
                options = f":alt: {alt}\n:target: '#{_anchor(key)}'\n"
                thumbnails.append(f"```{{figure}} {where}-small.png\n{options}\n{name}\n```\n")
                sections.append(f"```{{image}} {where}.png\n:alt: {alt}\n:loading: lazy\n```\n")
            sections.append(_code(code))
    opening = """# Gallery

Every figure, with the question that it answers and the code that draws it. `result.plot.<Tab>`
lists the figures of a result; each returns a Matplotlib figure or its axes.
"""
    grid = "::::{container} gallery\n" + "\n".join(thumbnails) + "::::\n"
    page.write_text("\n".join([opening, grid, *sections]), encoding="utf-8")
    return process_time() - started


def main(page: Path) -> None:
    """Write the page, in a folder of its own for the files that the code makes."""
    with TemporaryDirectory() as scratch, chdir(scratch):
        print(f"gallery: {write(page, page.parent / 'gallery'):.0f} s of processor time")
