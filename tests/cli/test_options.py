"""Every option of every command with every odd value: one sentence that names it, before any work.

Options and their kinds come from the command line's own declaration: a new one is covered by
itself.
"""

from __future__ import annotations

import inspect
import math
import sys
from pathlib import Path

import pytest
import typer
from scipy.optimize import brentq

import starcal_uq as sc
from starcal_uq.cli import commands as declared
from starcal_uq.cli.app import main
from tests.helpers.scenes import observations

# Arguments with which each command would work.
VALID = {
    "demo": "-o NEW",
    "run": "OBS CAMERA -o NEW",
    "simulate": "CAMERA -o NEW.csv",
    "calibrate": "OBS CAMERA -o NEW",
    "sample": "RUN",
    "coupling": "RUN",
    "propagate": "RUN",
    "report": "RUN",
    "new": "camera -o NEW.toml",
    "export": "RUN --to covariance",
    "budget": "RUN",
    "compare": "RUN RUN",
    "plan": "CAMERA",
    "study": "OBS",
    "centroid": "IMAGES -o NEW.csv",
    "identify": "OBS CAMERA -o NEW.csv",
    "inspect": "RUN 0 -o NEW.html",
    "filter": "OBS CAMERA -o NEW",
    "validate": "CAMERA",
    "diagnose": "RUN",
    "merge": "RUN RUN -o NEW",
    "reproduce": "-o NEW",
    "reproduce-field": "-o NEW",
    "schema": "coupling",
}
LONG = 100_000 * "x"
CONTROLS = "\x1b[31mred\x07\nline"
WHOLE = ("-1", "0", "1.5", str(10**30), "-" + str(10**30), 5000 * "9", "nan", "", "three", CONTROLS)
FLOATS = ("nan", "inf", "-inf", "-1", "0", "1e-300", "1e300", "1e999", "", "three", CONTROLS)
TEXTS = ("", LONG, CONTROLS, "nonsense")
PATHS = ("", LONG, CONTROLS, "/dev/zero", "missing", "folder", "OBS/below")
# Paths to which something is written; what is missing there is what is wanted.
WRITTEN = {"out", "template", "images"}


class BeginsError(BaseException):
    """The work of a command would begin here."""


@pytest.fixture(scope="module")
def commands():
    return declared.app.commands


@pytest.fixture
def parse(commands, monkeypatch, capsys, tmp_path):
    """Whether a command accepts its arguments; the sentence with which it refuses them
    otherwise.
    """
    monkeypatch.chdir(tmp_path)
    for folder in ("folder", "RUN", "IMAGES"):
        Path(folder).mkdir()
    for file in ("OBS", "CAMERA"):
        Path(file).write_text("")

    def begin(**_):
        raise BeginsError

    for command in commands.values():
        monkeypatch.setattr(command, "callback", begin)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["starcal-uq", *arguments])
        try:
            main()
        except BeginsError:
            return None
        except SystemExit as stop:
            err = capsys.readouterr().err
            line = err.removesuffix("\n")
            good = (
                line.startswith("error: ")
                and line.isprintable()
                and line.endswith(".")
                and len(line) < 400
            )
            return err if stop.code == 2 and good else f"{stop.code}: {err}"
        raise AssertionError(f"{arguments}: the command neither began nor ended.")

    return call


def named(parameter):
    return {*parameter.opts, *parameter.secondary_opts, parameter.name, parameter.metavar} - {None}


def kind_of(parameter):
    """Type of one value: int, float, bool, Path, "choice" or str."""
    declared = parameter.type_descriptor
    inner = typer._typing.get_args(declared.annotation) if declared.choices is None else ()
    return "choice" if declared.choices is not None else inner[0] if inner else declared.annotation


def call_with(command, parameter, value):
    """Arguments of a valid call in which one parameter has a value."""
    words = VALID[command.name].split()
    if parameter.opts[0].startswith("-"):
        given = [f"{max(parameter.opts, key=len)}={value}"]
        if parameter.nargs == 2:
            given = [parameter.opts[0], value, value]
        for option in parameter.opts:
            if option in words:
                at = words.index(option)
                del words[at : at + 2]
        return [command.name, *words, *given]
    places = [p for p in command.params if not p.opts[0].startswith("-")]
    words[places.index(parameter)] = value
    options, arguments = [], []
    rest = iter(words)
    for word in rest:
        if word.startswith("-") and word != value:
            options += [word, next(rest)]
        else:
            arguments.append(word)
    return [command.name, *options, "--", *arguments]


def legitimate(parameter, kind, value):
    """Whether a value that is accepted may be."""
    if kind in (int, float):
        number = float(value)
        assert math.isfinite(parameter.min) and math.isfinite(parameter.max), parameter.name
        return parameter.min <= number <= parameter.max
    if kind is Path:
        return (value in ("missing", CONTROLS) and parameter.name in WRITTEN) or (
            value == "folder"
            and parameter.metavar not in ("CAMERA", "SITE", "CENTROIDS", "TOML", "STUDY")
        )
    return kind is str and parameter.name in {"scheduler", "frames"} and value == "nonsense"


ODD = {int: WHOLE, float: FLOATS, str: TEXTS, "choice": TEXTS, Path: PATHS, bool: ("perhaps",)}


def test_every_option_refuses_odd_values_in_one_sentence(commands, parse):
    assert set(VALID) == set(commands)
    refused, accepted, problems = 0, 0, []
    for command in commands.values():
        assert parse(command.name, *VALID[command.name].split()) is None
        for parameter in command.params:
            kind = kind_of(parameter)
            if kind is bool and parameter.name == "help":
                continue
            for value in ODD[kind]:
                sentence = parse(*call_with(command, parameter, value))
                good = (
                    legitimate(parameter, kind, value)
                    if sentence is None
                    else sentence.startswith("error: ")
                    and any(name in sentence for name in named(parameter))
                )
                refused, accepted = refused + (sentence is not None), accepted + (sentence is None)
                if not good:
                    problems.append((command.name, parameter.name, value[:40], sentence))
    assert not problems, "\n".join(map(str, problems))
    assert refused > 1000 and accepted < 0.2 * refused


def test_memory_that_is_not_there_is_a_sentence(parse, commands, monkeypatch):
    def begin(*_, **__):
        raise MemoryError

    monkeypatch.setattr(commands["demo"], "callback", begin)
    assert (
        parse("demo")
        == "error: there is not enough memory for this: ask for fewer draws, frames or samples.\n"
    )


def test_control_sentences_and_the_judge_of_accepted_values(commands, parse):
    seed = next(p for p in commands["demo"].params if p.name == "seed")
    assert not legitimate(seed, int, "-1")
    assert parse("demo", "-o", "NEW", "--seed", "3") is None
    assert parse("demo", "-o", "NEW", "--seed", "-1") == (
        "error: --seed '-1': give a whole number from 0 to 18446744073709551615.\n"
    )
    assert parse("sample", "RUN", "--likelihood", "magic") == (
        "error: --likelihood 'magic' is unknown: use one of marginal, pairs, pairs_naive, "
        "student_t.\n"
    )


# Calls that end soon; sampling last, because it makes the rest of a run stale.
WORK = {
    "simulate": "CAMERA.toml -o o.csv --frames 5 --force",
    "centroid": "IMAGES -o c.csv --force",
    "identify": "CENTROIDS.csv CAMERA.toml -o i.csv --max-mag 6 --force",
    "filter": "OBS.csv CAMERA.toml -o FILTERED --sigma 0.05 --force",
    "propagate": "RUN --attitudes random --frames 20 --alignment-frames 3 --draws 50 --force",
    "diagnose": "RUN --starts 1 --force",
    "budget": "RUN --force",
    "compare": "RUN --split halves",
    "sample": "RUN --ensembles 2 --walkers 14 --steps 20 --force",
}


@pytest.mark.slow
def test_the_least_and_oddest_numbers_that_are_accepted_work_or_are_refused(
    commands, cli, tmp_path
):
    camera = sc.paper.paper_start()
    camera.save(tmp_path / "CAMERA.toml")
    obs = observations(n_frames=12, seed=3)
    obs.save(tmp_path / "OBS.csv")
    run = sc.Run(tmp_path / "RUN")
    run.calibrate(obs, camera)
    run.sample(seed=0, n_ensembles=2, n_walkers=14, n_steps=20)
    run.propagate(n_draws=50, seed=0)
    cli.ok("simulate CAMERA.toml -o s.csv --frames 3 --images IMAGES")
    cli.ok("centroid IMAGES -o CENTROIDS.csv")
    tried = 0
    for name, arguments in WORK.items():
        for parameter in commands[name].params:
            kind = kind_of(parameter)
            if kind not in (int, float):
                continue
            odd = {parameter.min} | ({0.0, 1e-300, -1.0} if kind is float else set())
            for value in sorted(v for v in odd if parameter.min <= v <= parameter.max):
                words, option = arguments.split(), max(parameter.opts, key=len)
                if option in words:
                    del words[words.index(option) : words.index(option) + 2]
                status, _, err = cli(name, *words, f"{option}={value}")
                lines = [line for line in err.splitlines() if line.startswith("error: ")]
                assert status in (0, 1) or (
                    status == 2 and len(lines) == 1 and lines[0].endswith(".")
                ), (option, err)
                assert "nan" not in " ".join(lines), (option, value, err)
                tried += 1
    assert tried > 40


def test_switches_of_earlier_versions_name_the_effect_in_their_place(cli):
    switches = {"--robust": "tails", "--noise model": "noise", "--star-errors": "star"}
    for words, effect in switches.items():
        said = f"{words.split()[0]} is no option any more: give --effects {effect} in its place."
        for command in ("calibrate", "run"):
            cli.refuses(said, f"{command} obs.csv camera.toml -o run {words}")
        # Control: other commands have never had them.
        assert "no option any more" not in cli(f"report run {words}")[2]


def test_a_remedy_adds_its_effect_to_the_list_that_was_given(monkeypatch):
    from starcal_uq.cli.remedies import as_given
    from starcal_uq.core.remedy import calibrated

    (remedy,) = calibrated(effects="tails")
    for given, wanted in (
        (
            ["--effects", "field,noise", "--seed", "3"],
            "--seed 3 --force --effects field,noise,tails",
        ),
        (["--effects=tails"], "--force --effects tails"),
        (["--effects", "none"], "--force --effects tails"),
    ):
        words = ["starcal-uq", "calibrate", "obs.csv", "camera.toml", *given]
        monkeypatch.setattr("sys.argv", words)
        assert as_given(remedy) == f"starcal-uq calibrate obs.csv camera.toml {wanted}"


def test_a_remedy_of_a_run_file_repeats_nothing_that_was_given(monkeypatch, tmp_path):
    from starcal_uq.cli.remedies import as_given
    from starcal_uq.cli.runfiles import expand
    from starcal_uq.core.remedy import calibrated

    file = tmp_path / "run.toml"
    file.write_text('[run]\ninputs = "a.csv"\nout = "r"\n', encoding="utf-8")
    words = ["run", str(file), "--force", "--set", "effects=field", "--set", "seed=3"]
    monkeypatch.setattr("sys.argv", ["starcal-uq", *expand(words, declared.app.commands)])
    (remedy,) = calibrated(effects="tails")
    wanted = f"starcal-uq run {file} --set seed=3 --set effects=field,tails --force"
    assert as_given(remedy) == wanted
    expand([], declared.app.commands)


def test_help_lists_the_distortion_models(commands):
    (model,) = (one for one in commands["run"].params if one.name == "model")
    assert f"One of: {', '.join(sc.camera.model_names())}, or one of" in model.help


def test_docstrings_of_libraries_are_missing_within_a_command_only(monkeypatch):
    found = []

    def command():
        found.extend(map(inspect.getdoc, (brentq, main)))
        raise SystemExit(2)

    monkeypatch.setattr("starcal_uq.cli.app._main", command)
    with pytest.raises(SystemExit):
        main()
    assert found[0] is None
    assert found[1].startswith("Run a command")
    assert "root" in inspect.getdoc(brentq)
