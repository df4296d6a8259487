"""Every remedy that is printed as a command or a call is executed, and none is printed that is not
listed here.
"""

from __future__ import annotations

import ast
import copy
import dataclasses
import re
import shlex
import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer

import starcal_uq as sc
from starcal_uq.calibration.cameras import MixedCameras
from starcal_uq.cli.commands import app
from starcal_uq.core import remedy
from starcal_uq.core.status import CODES, Check, Code, Level, Question, Status
from starcal_uq.diagnostics.diagnose import MultiStart
from starcal_uq.diagnostics.times import TimeTest
from starcal_uq.diagnostics.verdict import draws, estimate, observed
from starcal_uq.inference import checks
from starcal_uq.inference.derived import derived_quantities
from starcal_uq.runs.folder import FILES
from tests.helpers.ground_scenes import NOMINAL, SITE, ground_frames
from tests.helpers.outside import campaign
from tests.helpers.scenes import observations
from tests.helpers.ties import gyro, known_of, stare

PACKAGE = Path(sc.__file__).parent
TIME = "2026-11-25T02:00:00"
DOCUMENTED = "docs/explanation/misfit.md"
SHORT = {"n_ensembles": 2, "n_walkers": 14, "n_steps": 20}
pytestmark = pytest.mark.usefixtures("few_importance_draws")


def changed(post, **changes):
    return dataclasses.replace(post, diagnostics=dataclasses.replace(post.diagnostics, **changes))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Short runs with their files, and observations from the ground."""
    folder = tmp_path_factory.mktemp("small")
    camera = sc.paper.paper_start()
    camera.save(folder / "CAMERA.toml")
    NOMINAL.save(folder / "GROUND_CAMERA.toml")
    SITE.save(folder / "SITE.toml")
    altitudes = np.linspace(20.0, 80.0, 12)
    ground = ground_frames(
        sc.load_catalogue(max_mag=6.5, epoch=2026.9), altitudes, times=12 * [TIME]
    )
    # Of tables without times the remedies give the time as well.
    dataclasses.replace(ground, time_utc=None).save(folder / "GROUND_OBS.csv")
    c = campaign(np.random.default_rng(1), n_frames=12, patch_stars=20, star_sigma_px=0.05)
    patch, sheet = (
        sc.Observations(**c.columns),
        sc.Camera(**c.camera_toml(), coefficients=(0.0, 0.0)),
    )
    c = campaign(
        np.random.default_rng(2),
        n_frames=30,
        sigma_px=lambda radius, mag, frame: 0.03 * (1.0 + 3.0 * radius),
    )
    uneven = sc.Observations(**c.columns)
    c = campaign(np.random.default_rng(3), n_frames=30)
    bent, rotations = sc.Observations(**c.columns), gyro(np.random.default_rng(4), c, 5.0)
    path, times = stare(np.random.default_rng(5), 12, 5.0, 40.0, 5.0)
    columns = campaign(np.random.default_rng(6), n_frames=12, path=path).columns
    turned = sc.Observations(**columns, time_utc=times[columns["frame"]])
    turned.select(np.abs(turned.xy - 511.5).max(axis=1) < 511.0).save(folder / "TURNED_OBS.csv")
    patch.save(folder / "PATCH_OBS.csv")
    for name in ("PATCH", "TURNED"):
        sheet.save(folder / f"{name}_CAMERA.toml")
    for name, seed in (("RUN_B", 5), ("RUN_A", 3)):
        obs = observations(n_frames=12, seed=seed)
        run = sc.Run(folder / name)
        cal = run.calibrate(obs, camera)
        post = run.sample(seed=0, **SHORT)
        run.propagate(n_draws=50, seed=0)
    obs.save(folder / "OBS.csv")
    shutil.copytree(folder / "RUN_A", folder / "RUN")
    tables = {"obs": obs, "patch": patch, "uneven": uneven, "bent": bent, "turned": turned}
    tables |= {"rotations": known_of(rotations, 0.2)}
    return SimpleNamespace(folder=folder, camera=camera, cal=cal, post=post, sheet=sheet, **tables)


def short_of(kind, small):
    with pytest.warns(sc.inference.NaivePairsWarning):
        return sc.sample(small.obs, small.cal, seed=0, likelihood=kind, **SHORT)


E = np.eye(6)
PHASE = SimpleNamespace(
    against="pixel phase in x",
    name="phase",
    is_of_noise=False,
    p_holm=1e-9,
    size_px=0.1,
    moved_sigma=0.0,
    moved_std=0.0,
    moved_name="",
)


# What makes each function that makes a check find fault; what all of them give to try is executed,
# or parsed.
EXAMPLES = {
    "inference.checks._rhat": lambda s: [checks._rhat(changed(s.post, rhat=np.full(6, 1.1)))],
    "inference.checks._effective_draws": lambda s: [
        checks._effective_draws(changed(s.post, ess_tail=np.full(6, 90.0)))
    ],
    "inference.checks._acceptance": lambda s: [
        checks._acceptance(changed(s.post, acceptance=np.full(2, 0.01)))
    ],
    "inference.checks._derived": lambda s: [
        checks._derived(post, derived_quantities(post))
        for post in [dataclasses.replace(s.post, draws=s.drifting)]
    ],
    "inference.checks._digits": lambda s: [checks._digits(changed(s.post, mcse=0.1 * s.post.sd))],
    "inference.checks._degrees_of_freedom": lambda s: [
        checks._degrees_of_freedom(
            dataclasses.replace(s.post, dof_draws=np.arange(float(len(s.post.draws))))
        )
    ],
    "inference.checks._bounds": lambda s: [
        checks._bounds(dataclasses.replace(s.post, draws=s.post.draws + shift))
        for shift in (1e5 * E[0], 1e-5 * E[3])
    ],
    "inference.checks._priors": lambda s: [
        checks._priors(dataclasses.replace(s.post, priors=s.post.priors.replace(**priors)))
        for priors in ({"focal_fraction": 1e-6}, {"focal_px": 1.5 * s.post.priors.focal_px})
    ],
    "inference.checks._independent": lambda s: [
        checks._independent(changed(s.post, **found))
        for found in ({"agreement_sd": 2.0}, {"psis_khat": 2.0})
    ],
    "inference.checks._evaluation": lambda s: [
        checks._evaluation(changed(s.post, compressed_max_difference=value))
        for value in (9.0, float("nan"))
    ],
    "inference.checks._likelihood": lambda s: [checks._likelihood(short_of("pairs_naive", s), {})],
    "inference.named.find_source": lambda s: list(
        sc.sample(
            s.obs,
            sc.calibrate(s.obs, s.camera, method="least_squares"),
            seed=0,
            likelihood="pairs",
            **SHORT,
        ).diagnostics.checks[:1]
    ),
    "diagnostics.verdict.draws.same_data": lambda s: [
        draws.same_data(
            dataclasses.replace(s.post, provenance={"data_sha256": "0"}), s.obs.data_hash
        )
    ],
    "diagnostics.verdict.draws.propagation": lambda s: [
        draws.propagation(
            SimpleNamespace(
                n_draws=50,
                **dict.fromkeys(("common_arcsec", "rest_arcsec"), np.ones(3)),
                **dict.fromkeys(
                    ("analytic_common_arcsec", "analytic_rest_arcsec"), np.full(3, 9.0)
                ),
            )
        )
    ],
    "diagnostics.verdict.estimate.estimation": lambda s: [
        estimate.estimation(dataclasses.replace(s.cal, status=status))
        for status in Status
        if not status.ok
    ],
    "diagnostics.verdict.estimate.determined": lambda s: [
        estimate.determined(
            dataclasses.replace(
                s.cal,
                provenance={
                    "fallback": {
                        "model": "brown3",
                        "used": "brown",
                        "because": "the stars are too few",
                    }
                },
            )
        )
    ],
    "diagnostics.verdict.estimate.estimators_agree": lambda s: [
        estimate.estimators_agree(
            dataclasses.replace(s.cal, pair_theta=s.cal.theta + 99.0 * s.cal.sigmas)
        )
    ],
    "diagnostics.verdict.estimate.rotations_agree": lambda s: [
        estimate.rotations_agree(sc.calibrate(obs, s.sheet, **options))
        for obs, options in (
            (s.bent, {"relative_attitudes": s.rotations}),
            (s.turned, {"mount": "fixed", "mount_sigma_arcsec": 1.0}),
        )
    ],
    "diagnostics.verdict.estimate.against_truth": lambda s: [
        estimate.against_truth(s.cal, s.camera.replace(x0_px=900.0), s.post)
    ],
    "diagnostics.verdict.estimate.starts": lambda s: [
        estimate.starts(found)
        for found in (
            MultiStart(8, 6, 2, 0, 0.0, start=(70.1, 511.5, 520.25)),
            MultiStart(8, 6, 2, 0, 0.0),
            MultiStart(8, 6, 0, 2, 0.0),
        )
    ],
    "diagnostics.verdict.estimate.misfit": lambda s: [
        estimate.misfit(found, cal)
        for cal in (sc.calibrate(s.bent, s.sheet, model="none"),)
        for found in (
            sc.diagnostics.misfit_tests(s.bent, cal),
            SimpleNamespace(tests=[PHASE], found=lambda level: [PHASE], pattern=None),
        )
    ],
    "diagnostics.verdict.estimate.predictive": lambda s: [
        estimate.predictive(
            SimpleNamespace(
                statistics=[SimpleNamespace(name="tails", p_value=0.0, extreme=True)], n_draws=500
            )
        )
    ],
    "diagnostics.verdict.estimate.one_camera": lambda s: [
        estimate.one_camera(MixedCameras(2, "the frames are of 2 cameras", "0-5,8"))
    ],
    "diagnostics.verdict.estimate.comparison": lambda s: [
        estimate.comparison(
            sc.diagnostics.compare_models(s.bent, sc.calibrate(s.bent, s.sheet, model="none"))
        )
    ],
    "diagnostics.verdict.estimate.even_noise": lambda s: [
        estimate.even_noise(found)
        for whole in [sc.diagnostics.misfit_tests(s.uneven, sc.calibrate(s.uneven, s.sheet))]
        for found in (whole, dataclasses.replace(whole, uneven=None))
    ],
    "diagnostics.verdict.estimate.jackknife": lambda s: [
        estimate.jackknife(found, moving)
        for found in [
            dataclasses.replace(
                s.jackknife, sandwich_covariance=9.0 * s.jackknife.formal_covariance
            )
        ]
        for moving in ((), observed.EFFECTS)
    ],
    "diagnostics.verdict.estimate.stars": lambda s: [
        estimate.stars(sc.diagnostics.star_test(s.patch, sc.calibrate(s.patch, s.sheet)))
    ],
    "diagnostics.verdict.observed.directions": lambda s: (
        [
            observed.directions(dataclasses.replace(s.obs, meta=meta), s.cal)
            for meta in (
                {"directions": "undeclared"},
                {"directions": "apparent", "observer": "unknown"},
            )
        ]
        + [
            observed.directions(s.obs, s.cal, None, TimeTest(cause, *(4 * [1.0]), "f", 2.0))
            for cause in ("aberration twice", "no aberration", "epoch", "date", "hour")
        ]
    ),
    "diagnostics.verdict.observed.residual_pattern": lambda s: [
        observed.residual_pattern(s.bent, sc.calibrate(s.bent, s.sheet, model="none"))
    ],
    "diagnostics.verdict.observed.noise": lambda s: (
        [
            observed.noise(
                dataclasses.replace(s.obs, sigma_px=np.full(s.obs.n_stars, stated)),
                dataclasses.replace(s.cal, **noise),
            )
            for stated, noise in (
                (0.05, {"sigma": 9.0}),
                (0.05, {"sigma": 1e-4}),
                (0.05, {"sigma": 0.2, "sigma_name": "sigma_scale"}),
                (1.0, {"sigma": s.cal.camera.focal_px / 206265.0, "sigma_name": "sigma_scale"}),
            )
        ]
        + [
            observed.noise(s.uneven, dataclasses.replace(cal, sigma=99.0))
            for cal in (sc.calibrate(s.uneven, s.sheet, effects="noise"),)
        ]
    ),
    "diagnostics.verdict.observed.partitions": lambda s: [
        observed.partitions(
            dataclasses.replace(
                s.cal,
                partitions=SimpleNamespace(
                    n_stars=np.array([99, 99]),
                    n_frames=np.array([9, 9]),
                    chi2=s.cal.sigma**2 * np.array([900.0, 170.0]),
                ),
            )
        )
    ],
    "diagnostics.verdict.observed.coverage": lambda s: [
        observed.coverage(
            obs, dataclasses.replace(s.cal, residuals_px=s.cal.residuals_px[: obs.n_stars])
        )
        for obs in (s.obs.select_frames(s.obs.frame_ids[:3]), s.obs.select(s.obs.x_px < 500.0))
    ],
    "diagnostics.verdict.observed.screening": lambda s: [
        observed.screening(
            s.obs.with_meta(screening={"rejected": 0, "of": 9, "blame": "the model is wrong."})
        )
    ],
    "diagnostics.verdict.observed.terms": lambda s: [
        observed.terms(
            dataclasses.replace(
                s.cal,
                partitions=SimpleNamespace(
                    richer=[SimpleNamespace(model="brown3", n_terms=1, gain=99.0)]
                ),
            )
        )
    ],
    "diagnostics.verdict.observed.outliers": lambda s: [
        observed.outliers(s.obs, dataclasses.replace(s.cal, residuals_px=s.cal.residuals_px * 9.0))
    ],
}

# Commands that sentences name, and what makes them small where they stand alone.
COMMANDS = {
    "budget RUN": "",
    "budget RUN --template FILE": "",
    "budget RUN --template budget.toml": "",
    "calibrate": "OBS CAMERA -o RUN --force",
    "calibrate OBS CAMERA -o RUN": "--force",
    "calibrate OBS CAMERA -o RUN --screen": "--force",
    "compare RUN_A RUN_B -o DIR": "",
    "coupling RUN": "",
    "budget RUN --force": "",
    "propagate RUN": "--draws 50 --force",
    "propagate RUN --attitudes random": "--draws 50 --force",
    "propagate RUN --force": "--draws 50",
    "report RUN": "",
    "sample RUN": "--force --steps 20",
    "sample RUN --force": "--steps 20",
}
# These take long or files of their own; the tests that execute them stand beside them.
ELSEWHERE = {
    "calibrate OBS CAMERA --effects temperature": "tests/cli/test_steps_effects.py",
    "centroid": "tests/cli/test_images.py",
    "demo": "tests/runs/test_run.py",
    "diagnose RUN": "tests/cli/test_statistics.py",
    "diagnose RUN --force": "tests/cli/test_statistics.py",
    "inspect RUN": "tests/cli/test_images.py",
    "propagate RUN --attitudes PROFILE": "tests/cli/test_mission.py",
    "propagate RUN --temperature-profile FILE": "tests/cli/test_steps_effects.py",
    "propagate RUN --temperature-profile FILE --force": "tests/cli/test_steps_effects.py",
    "report RUN --format pdf": "tests/presentation/test_report.py",
    "report RUN --notebook": "tests/presentation/test_report.py",
    "schema": "tests/cli/test_schemas.py",
    "reproduce": "tests/cli/test_paper.py",
    "run IMAGES... -o RUN": "tests/cli/test_images.py",
    "study STUDY.toml -o DIR": "tests/cli/test_study.py",
    "study": "tests/cli/test_study.py",
    "new study": "tests/cli/test_study.py",
    "validate CAMERA": "tests/cli/test_statistics.py",
}

# Arguments that sentences advise, and a call with each.
ARGUMENTS = {
    "evaluation='exact'": "sc.sample(obs, cal, n_ensembles=2, n_walkers=14, n_steps=20, {})",
    "likelihood='marginal'": "sc.sample(obs, cal, n_ensembles=2, n_walkers=14, n_steps=20, {})",
    "likelihood='pairs'": "sc.sample(obs, cal, n_ensembles=2, n_walkers=14, n_steps=20, {})",
    "likelihood='student_t'": "sc.sample(obs, cal, n_ensembles=2, n_walkers=14, n_steps=20, {})",
    "method='efficient'": "sc.calibrate(obs, camera, {})",
    "method='griffith'": "sc.calibrate(obs, camera, {})",
    "method='three_stage'": "sc.calibrate(obs, camera, {})",
    "parameters='all'": (
        "sc.calibrate(obs, camera, method='griffith', recursion=sc.paper.RecursionOptions({}))"
    ),
    "solver='ipopt'": "sc.calibrate(obs, camera, {})",
}


@cache
def trees(*words):
    """Modules and their trees; of those alone whose text holds one of some words."""
    return [
        (".".join(path.relative_to(PACKAGE).with_suffix("").parts), ast.parse(text))
        for path in sorted(PACKAGE.rglob("*.py"))
        for text in [path.read_text(encoding="utf-8")]
        if not words or any(word in text for word in words)
    ]


def sentences(tree):
    """All texts of a module but its docstrings, with {} for what is put in."""
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
        and isinstance(node.body[0], ast.Expr)
        and isinstance(node.body[0].value, ast.Constant)
    }
    parts = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(
                str(p.value) if isinstance(p, ast.Constant) else "{}" for p in node.values
            )
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and not {id(node)} & (docstrings | parts)
        ):
            yield node.value


def test_every_check_has_an_example():
    """A check function that is added is missing here until it has one."""
    giving, makers = set(), ("Check", "judged", "_converged", "_largest_error")
    for module, tree in trees(*(f"{maker}(" for maker in makers)):
        for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
            for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
                if getattr(call.func, "id", "") in makers:
                    giving.add(f"{module}.{function.name}")
    # Requirements of a budget have advice alone: tests/cli/test_mission.py.
    shared = {
        "core.status.judged",
        "diagnostics.verdict.estimate._largest_error",
        "inference.checks._converged",
        "budgeting.result._requirement_check",
    }
    assert giving - shared == set(EXAMPLES)


@pytest.fixture(scope="module")
def remedies(small):
    """All remedies, each once."""
    small.jackknife = sc.diagnostics.jackknife_frames(small.obs, small.cal)
    small.drifting = small.post.draws.copy()
    small.codes = set()
    small.drifting[: len(small.drifting) // 2] += small.post.sd
    found = {}
    for name, make in EXAMPLES.items():
        doubts = [check for check in make(small) if check.level is not Level.PASS]
        assert doubts, f"{name} found no fault"
        for check in doubts:
            small.codes.add(check.code)
            # Something to try: a command, a call, or an order of what to do with instrument or
            # data.
            assert re.fullmatch(r"\S.*\.", check.sentence), check.sentence
            assert check.value and check.bound and check.told is None, name
            assert check.remedies or check.advice, f"{name} gives nothing to try: {check}"
            assert not check.advice or re.fullmatch(r"[A-Z].*\.", check.advice), check.advice
            typed = any(remedy.command for remedy in check.remedies)
            assert typed or check.advice, f"{name} gives nothing to type: {check.remedy}"
            found |= dict.fromkeys(words for words, _ in check.ways)
    return list(found)


@pytest.fixture
def execute(small, cli, tmp_path):
    """Run a command as a user would, on a copy of the files; its words in capitals stand for
    them.
    """

    def run(command, more="", parse=False):
        folder = tmp_path / f"files{len(list(tmp_path.iterdir()))}"
        shutil.copytree(small.folder, folder)
        words = [*shlex.split(command), *shlex.split(more)]
        own = {"SITE": "GROUND_", "star": "PATCH_", "--mount": "TURNED_"}
        ground = next((name for word, name in own.items() if word in words), "")
        files = {
            "OBS": f"{ground}OBS.csv",
            "CAMERA": f"{ground}CAMERA.toml",
            "SITE": "SITE.toml",
            "FILE": "new.toml",
        }
        files |= {name: name for name in ("RUN", "RUN_A", "RUN_B", "DIR")}
        words = [
            str(folder / files[word]) if word in files else TIME if word == "UTC" else word
            for word in words
        ]
        if parse:
            app.commands[words[0]].make_context(words[0], words[1:])
            return
        # 1 is the verdict on so short a run; 2 is a command that cannot be.
        assert "error:" not in cli.ok(*words, among=(0, 1))[1]

    return run


def test_every_check_has_a_sentence_a_remedy_and_a_place_in_the_documentation(
    small, remedies, root
):
    # Requirements have the names and the words of a budget: tests/cli/test_mission.py.
    assert small.codes == set(Code) - {Code.REQUIREMENT}
    rows = re.findall(r"^\| ([^|]*) \|", (root / DOCUMENTED).read_text(encoding="utf-8"), re.M)
    assert [title for title in CODES if title not in rows] == []
    asked = [check.question for check in map(Check, Code)]
    assert [asked.count(question) for question in Question] == [11, 26, 1]
    # Control: the title of no check is in no row.
    assert "Requirements" not in rows


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_every_remedy_of_a_check_can_be_executed(small, remedies, execute, every):
    """Of those that differ in their options alone the fast tests execute one, and parse the others."""
    assert len(remedies) > 20
    names = {"sc": sc, "obs": small.obs, "camera": small.camera, "cal": small.cal}
    executed = set()
    for tried in remedies:
        program, _, command = tried.partition(" ")
        if program == "starcal-uq":
            words = command.split()
            again = words[0] in executed and not every
            executed.add(words[0])
            more = {"sample": "--ensembles 2 --walkers 14 --steps 20", "plan": "--frames 10"}.get(
                words[0], ""
            )
            # It takes long; a test of its own executes it.
            execute(command, more, parse=again or words[0] == "validate")
        else:
            assert tried.startswith("sc."), tried
            own = {"'star'": small.patch, "mount=": small.turned}
            stars = next((obs for word, obs in own.items() if word in tried), None)
            given = {} if stars is None else {"obs": stars, "camera": small.sheet}
            eval(tried, names | given)


def texts():
    """All texts of the package; those of the help stand in a table beside the modules."""
    for _, tree in trees():
        yield from sentences(tree)
    cli, presentation = PACKAGE / "cli", PACKAGE / "presentation"
    for path in (*cli.glob("*.toml"), *cli.glob("*.txt"), *presentation.rglob("*.toml")):
        yield path.read_text(encoding="utf-8").replace("\\\n", "")


def named(pattern):
    return {match for text in texts() for match in re.findall(pattern, text)}


# Where remedies are made of others, and those of checks and frames, whose tests execute them.
OF_THEIR_OWN = (
    "core.remedy",
    "diagnostics.verdict.",
    "inference.checks",
    "presentation.words.images",
    "runs.folder",
)
CAPITALS = {
    name: getattr(remedy, name) for name in ("OBS", "CAMERA", "RUN", "SOME_IMAGES", "Remedy")
}


def written():
    """The remedies that sentences name, RUN for each file that is known while it runs alone."""
    for module, tree in trees("Remedy("):
        if module.startswith(OF_THEIR_OWN):
            continue
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            if getattr(call.func, "id", "") != "Remedy" or not isinstance(
                call.args[0], ast.Constant
            ):
                continue
            call = copy.deepcopy(call)
            for files in (arg for arg in call.args if isinstance(arg, ast.Tuple)):
                files.elts = [
                    file if isinstance(file, (ast.Constant, ast.Name)) else ast.Constant("RUN")
                    for file in files.elts
                ]
            expression = ast.fix_missing_locations(ast.Expression(call))
            yield eval(compile(expression, module, "eval"), dict(CAPITALS))
    for path in (*PACKAGE.rglob("*.j2"), *PACKAGE.rglob("*.toml")):
        text = path.read_text(encoding="utf-8")
        for call in re.findall(r'Remedy\("\w+"(?:, \([^()]*\))?(?:, \{[^}]*\})?\)', text):
            yield eval(call, dict(CAPITALS))


@pytest.mark.parametrize("parse", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_command_in_a_sentence_can_be_executed(execute, root, parse):
    commands = {re.sub(r"\{\}", "RUN", command) for command in named(r"`starcal-uq ([^`]*)`")}
    commands |= {one.command.removeprefix("starcal-uq ") for one in written()}
    # Those that make the files of a run.
    commands |= {file.remedy.command.removeprefix("starcal-uq ") for file in FILES.values()}
    assert commands == COMMANDS.keys() | ELSEWHERE.keys()
    for command, more in COMMANDS.items():
        execute(command, more, parse=parse)
    for command, file in ELSEWHERE.items():
        text = (root / file).read_text(encoding="utf-8")
        assert re.search(rf'"{command.split()[0]}[ "]', text), command


def test_every_argument_in_a_sentence_can_be_given(small):
    clauses = named(
        r"\b(?:evaluation|likelihood|method|solver|parameters|moves|recursion)='[a-z_]+'"
    )
    assert clauses == set(ARGUMENTS)
    names = {"sc": sc, "obs": small.obs, "camera": small.camera, "cal": small.cal}
    for clause, call in ARGUMENTS.items():
        eval(call.format(clause), names)


def test_start_and_limit_are_those_of_the_calibration(small, cli, tmp_path):
    call = f"calibrate {small.folder}/OBS.csv {small.folder}/CAMERA.toml -o"
    cli.ok(f"{call} run --start focal_mm=71,x0_px=500")
    cal = sc.Run(tmp_path / "run").calibration
    assert (cal.nominal.focal_mm, cal.nominal.x0_px, cal.nominal.y0_px) == (
        71.0,
        500.0,
        small.camera.y0_px,
    )
    assert cal.theta == pytest.approx(small.cal.theta, rel=1e-4)
    assert cal.sigmas == pytest.approx(small.cal.sigmas, rel=1e-3)
    for wrong, words in (
        (
            "--max-iterations 1",
            "start closer to the optimum (--start) or raise max_iterations (--max-iterations)",
        ),
        ("--start f=70", "'f=70' is no start, such as focal_mm=50.2"),
        ("--start focal_mm=-1", "focal"),
    ):
        assert words in cli.refuses("", f"{call} other {wrong}").splitlines()[-1]
    assert not (tmp_path / "other").exists()


def test_control_a_remedy_that_names_no_option_is_refused(small, execute):
    with pytest.raises(sc.errors.SamplingError, match="evaluation='exact'"):
        sc.sample(small.obs, small.cal, likelihood="exact")
    with pytest.raises(AssertionError):
        execute("sample RUN --force --likelihood exact")
    with pytest.raises(typer.BadParameter, match="exact"):
        execute("sample RUN --force --likelihood exact", parse=True)


def test_an_error_of_wrong_stars_ends_with_the_command_that_was_given(small, cli, tmp_path):
    wrong = np.random.default_rng(1).random(small.obs.n_stars) < 0.05
    dataclasses.replace(small.obs, dec_deg=small.obs.dec_deg + 0.8 * wrong).save(
        tmp_path / "wrong ones.csv"
    )
    call = ("calibrate", "wrong ones.csv", small.folder / "CAMERA.toml", "-o", "new")
    command = re.search(r"`starcal-uq (.*)`", cli.refuses("", *call).splitlines()[-1])[1]
    assert shlex.split(command) == [*map(str, call), "--screen"]
    assert not (tmp_path / "new").exists()
    cli.ok(command, among=(0, 1))
