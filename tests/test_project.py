"""The project as a whole: what an import costs, what the files agree on, what the machinery
promises.
"""

from __future__ import annotations

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[1]
FIND_PYTHON = ROOT / "scripts" / "find_python.sh"
WINGS = sorted(path.parent.name for path in (ROOT / "starcal_uq").glob("*/__init__.py"))
HEAVY = (
    "arviz",
    "astropy",
    "casadi",
    "emcee",
    "jinja2",
    "matplotlib",
    "numpy",
    "pandas",
    "pyarrow",
    "scipy",
    "xarray",
)


def run_python(code: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    return run.stdout


def test_import_is_fast() -> None:
    """Half as long as a few modules of Python's own; `make bench` says how long that is."""

    def seconds(modules: str) -> float:
        return float(
            run_python(
                f"import time; t = time.process_time(); import {modules}; "
                "print(time.process_time() - t)"
            )
        )

    ours, reference = "starcal_uq", "dataclasses, importlib.metadata, json, pathlib, typing"
    seconds(ours)  # writes the compiled files
    assert min(seconds(ours) for _ in range(5)) < 1.5 * min(seconds(reference) for _ in range(5))


@pytest.mark.parametrize("user", ["sc", "list(sc.cli.commands.app.commands.values())"])
def test_import_loads_nothing_heavy(user: str) -> None:
    """Not for the package, and not for the help of a command."""
    code = f"import sys, starcal_uq as sc, starcal_uq.cli.commands; {user}; "
    code += f"print([name for name in {HEAVY} if name in sys.modules])"
    assert run_python(code).strip() == "[]"


def test_every_public_name_exists() -> None:
    code = (
        "import starcal_uq as sc; print([n for n in sc.__all__ if not hasattr(sc, n)], "
        "set(sc.__all__) - set(dir(sc)))"
    )
    assert run_python(code).strip() == "[] set()"


def test_versions_agree() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    citation = re.search(
        r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE
    )
    changelog = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert citation is not None
    assert changelog is not None
    assert (citation[1], changelog[1]) == (version, version)
    assert run_python("import starcal_uq; print(starcal_uq.__version__)").strip() == version


@pytest.mark.parametrize(
    "path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.name
)
def test_notebooks_store_no_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert cells
    assert all(not cell.outputs and cell.execution_count is None for cell in cells)


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_make_commands_in_the_texts_exist(name: str) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    commands = set(
        re.findall(
            r"^ {4}make ([a-z-]+)|`make ([a-z-]+)", (ROOT / name).read_text("utf-8"), re.MULTILINE
        )
    )
    named = {first or second for first, second in commands}
    assert named
    assert named <= targets


def test_links_in_the_texts_lead_somewhere() -> None:
    pages = [
        *ROOT.glob("*.md"),
        *(page for page in ROOT.glob("docs/**/*.md") if "_build" not in page.parts),
    ]

    def leads_somewhere(page: Path, target: str) -> bool:
        # Building the documentation brings the notebooks there.
        place = Path(os.path.normpath(page.parent / target))
        brought = (
            ROOT / "notebooks" / place.name
            if place.parent == ROOT / "docs" / "notebooks"
            else place
        )
        return brought.exists() or place.with_name(f"{place.name}.md").exists()

    broken = [
        f"{page.relative_to(ROOT)}: {target}"
        for page in pages
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text("utf-8"))
        if not leads_somewhere(page, target)
    ]
    assert broken == []


def test_constraints_pin_every_dependency() -> None:
    """Every line pins one version, and both sides of Python 3.12 are covered."""
    lines = [
        line
        for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()
        if not line.startswith("#")
    ]
    pattern = re.compile(r'([a-z0-9-]+)==[\w.]+(?: ; python_version (<|>=) "3\.12")?')
    pinned: dict[str, set[str]] = {}
    for line in lines:
        match = pattern.fullmatch(line)
        assert match, line
        pinned.setdefault(match[1], set()).update({match[2]} if match[2] else {"<", ">="})
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    wanted = [
        *project["dependencies"],
        *(d for extra in project["optional-dependencies"].values() for d in extra),
    ]
    names = {re.split(r"[\[<>=]", requirement)[0].lower() for requirement in wanted} - {
        "starcal-uq"
    }
    assert {name for name in names if pinned.get(name) != {"<", ">="}} == set()


# Names of imports that differ from their package's, and parts of ArviZ 1 and of pydantic.
IMPORTED_AS = {
    "PIL": "pillow",
    "cv2": "opencv_python_headless",
    "erfa": "pyerfa",
    "h5py": "h5netcdf",
    "llvmlite": "numba",
    "yaml": "pyyaml",
}
IMPORTED_AS |= {"arviz_base": "arviz", "arviz_plots": "arviz", "pydantic_core": "pydantic"}


def test_every_import_is_a_declared_dependency() -> None:
    """Otherwise the command works only where the tools of the tests happen to bring a package
    along.

    What an extra brings is imported in files that name this extra where it is missing.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]

    def names(requirements: list[str]) -> set[str]:
        return {
            re.split(r"[\[<>=]", requirement)[0].replace("-", "_") for requirement in requirements
        }

    extras = {name: names(brings) for name, brings in project["optional-dependencies"].items()}
    assert extras["all"] == {"starcal_uq"}
    assert project["optional-dependencies"]["all"] == [
        f"starcal-uq[{','.join(sorted(set(extras) - {'all', 'docs', 'test'}))}]"
    ]
    required = names(project["dependencies"]) | {"starcal_uq", *sys.stdlib_module_names}
    undeclared = set()
    for path in (ROOT / "starcal_uq").rglob("*.py"):
        text = path.read_text("utf-8")
        # Compiled loops are reached by one door, which looks first.
        named = {
            *re.findall(r'with extra\(\s*"(\w+)"', text),
            *(["compiled"] if path.parent.name == "loops" else []),
        }
        assert named <= set(extras), path.name
        allowed = required.union(*(extras[name] for name in named))
        for node in ast.walk(ast.parse(text)):
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                imported = [node.module or ""]
            roots = {name.partition(".")[0] for name in imported}
            undeclared |= {
                (path.name, root) for root in roots if IMPORTED_AS.get(root, root) not in allowed
            }
    assert undeclared == set()


def test_licences_of_all_that_is_installed_are_listed() -> None:
    """By name: a licence that changes with a version is seen when `make supply` makes the table
    anew.
    """
    from scripts.licences import PAGE, licences

    rows = re.findall(r"^\| \S.* \| ([\w-].*) \|$", PAGE.read_text("utf-8"), re.MULTILINE)
    listed = {name for row in rows for name in row.split(", ")}
    found = licences()
    assert {"numpy", "kiwisolver", "llvmlite"} <= set(found)  # direct, indirect, of an extra
    assert set(found) <= listed
    assert "not stated" not in found.values()


def find_python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": str(folder), "HOME": str(folder)}
    command = [shutil.which("sh") or "/bin/sh", str(FIND_PYTHON), *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


def script(path: Path, body: str) -> None:
    path.write_text(f"#!/bin/sh\n{body}\n", "utf-8")
    path.chmod(0o755)


def test_interpreter_that_does_not_run_is_passed_over(tmp_path: Path) -> None:
    script(tmp_path / "python3.13", "echo 'command not found' >&2; exit 127")
    script(tmp_path / "python3", f'exec "{sys.executable}" "$@"')
    run = find_python(tmp_path)
    assert (run.returncode, run.stderr) == (0, "")
    assert Path(run.stdout.strip()).samefile(sys.executable)


def test_missing_interpreter_is_one_sentence(tmp_path: Path) -> None:
    script(tmp_path / "python3", "exit 1")
    run = find_python(tmp_path)
    assert run.returncode == 1
    assert run.stdout == ""
    assert run.stderr.startswith("No Python 3.11 or newer was found")
    assert len(run.stderr.splitlines()) == 1


def test_interpreter_without_venv_names_the_package(tmp_path: Path) -> None:
    script(
        tmp_path / "python3",
        f'case "$2" in *ensurepip*) exit 1;; esac; exec "{sys.executable}" "$@"',
    )
    run = find_python(tmp_path)
    assert run.returncode == 1
    assert f"apt install python{sys.version_info[0]}.{sys.version_info[1]}-venv" in run.stderr


def test_second_interpreter_is_of_the_other_generation(tmp_path: Path) -> None:
    script(tmp_path / "python3", f'exec "{sys.executable}" "$@"')
    same = find_python(tmp_path, "--other", sys.executable)
    assert (same.returncode, same.stdout) == (0, "")
    # An interpreter that answers every question with yes passes for the other generation.
    script(tmp_path / "python3.12", "exit 0")
    script(tmp_path / "python3.11", "exit 0")
    assert find_python(tmp_path, "--other", sys.executable, "none").stdout == ""
    refused = find_python(tmp_path, "--other", sys.executable, str(tmp_path / "absent"))
    assert refused.returncode == 1
    assert "ALT_PYTHON" in refused.stderr


@pytest.mark.parametrize("wing", ["", *WINGS])
def test_no_public_name_is_that_of_a_module_beside_it(wing: str) -> None:
    """Importing such a module would put it in the function's place (`sc.calibrate` would no longer
    be callable).
    """
    modules = {path.stem for path in (ROOT / "starcal_uq" / wing).iterdir()}
    namespaces = set(WINGS) if not wing else {"errors"} if wing == "core" else set()
    package = importlib.import_module(f"starcal_uq.{wing}".rstrip("."))
    assert not (modules & set(getattr(package, "__all__", ()))) - namespaces
    assert all(getattr(package, name) is not None for name in getattr(package, "__all__", ()))


def test_files_do_not_import_each_other_in_circles() -> None:
    """Neither within wings nor between them; an annotation counts."""
    graph = grimp.build_graph("starcal_uq", exclude_type_checking_imports=False)
    sorter = TopologicalSorter(
        {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    )
    sorter.prepare()  # raises CycleError with the circle in its message
    assert sorter.is_active()


def test_only_the_command_line_spells_commands(root):
    """Below it, remedies are an action and its arguments; the name of the distribution stands
    once.
    """
    package = root / "starcal_uq"
    files = [path for path in package.rglob("*") if path.suffix in (".py", ".j2", ".toml", ".css")]
    below = [path for path in files if "cli" not in path.relative_to(package).parts]
    found = {
        str(path.relative_to(package)): path.read_text(encoding="utf-8").count("starcal-uq")
        for path in below
    }
    assert {name: n for name, n in found.items() if n} == {"core/provenance.py": 1}
    # Control: the command line has them.
    assert len(files) > len(below) > 300


# Files whose tests stand under another name: records, words and figures are seen in what shows
# them, steps and small parts in what calls them. The list may only shrink.
WITHOUT_NAMESAKE = {
    "attitude": "earth",
    "budgeting": "posterior result sampling",
    "calibration": "methods",
    "camera": "fields formats",
    "cli": "answers console results run schema settings starters",
    "comparison": "covariance result significance",
    "core": "conflicts constants documents errors facts findings remedy status times types",
    "diagnostics": "explain misfit_test noise_tests residuals shape_sums",
    "estimation": (
        "assemble duplicates kept local_effects normals "
        "partitioned_effects residual_map scales settings stages undetermined "
        "weights"
    ),
    "identification": "brightness engine growth match nearby outcome pairs proposers pyramid result sheet",
    "images": "background detection extract fits fits_files image pixel_phase pixels psf raw",
    "inference": "derived surrogate",
    "likelihood": (
        "arrays effect_likelihood effect_sums elimination expansion "
        "frame_products ipopt loops/common loops/frames loops/unrolled "
        "noise_model paths shapes star_errors zenith"
    ),
    "maths": "linear",
    "observations": "checks columns frames rows splits written",
    "paper": (
        "camera checks commands errors judgement published readings result show/figures "
        "show/pages show/tables show/views statistics"
    ),
    "pipeline": "cameras images",
    "planning": "check costs effects forecast information open_distortion",
    "presentation": (
        "html pages/comparison pages/gallery pages/notebook pages/planning "
        "pages/printing pages/studies pages/write tables"
    ),
    "propagation": "attitude_error geometry onboard_error sampled",
    "runs": (
        "compare frames merge priors report steps/budgeting steps/estimate steps/images "
        "steps/misfit steps/mission steps/pages steps/posterior"
    ),
    "simulation": "campaign contamination mission pointing psf truth",
    "sky": "cds gaia names positions",
    "studies": "axes cells definition geometry result store",
}


def test_tests_are_found_by_the_name_of_the_file():
    """`tests/WING/test_FILE.py` or `test_FILE_ASPECT.py`, also by the name of the folder inside the
    wing.
    """
    tests = {path.relative_to(ROOT / "tests").as_posix() for path in ROOT.glob("tests/*/test_*.py")}
    missing, found = set(), set()
    for wing in WINGS:
        for path in (ROOT / "starcal_uq" / wing).rglob("[a-z]*.py"):
            file = path.relative_to(ROOT / "starcal_uq" / wing).with_suffix("")
            named = re.compile(rf"{wing}/test_({'|'.join(file.parts)})(_\w+)?\.py")
            (found if any(map(named.fullmatch, tests)) else missing).add(
                f"{wing}/{file.as_posix()}"
            )
    listed = {
        f"{wing}/{file}" for wing, files in WITHOUT_NAMESAKE.items() for file in files.split()
    }
    assert missing <= listed, "write a test of this name"
    assert not listed & found, "these have a test now: take them from the list"
