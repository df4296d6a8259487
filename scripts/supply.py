"""What users install, tested from empty environments: ``make supply``.

    supply.py [--all] [--only PART ...] [--python VERSION ...] [--keep FOLDER]

1. The source distribution is built, and the wheel from it; both are compared with what is under
version control.
2. For each Python: the wheel without any extra into an empty environment, at the versions of
   `constraints.txt`; the tests run against it in a folder without the package's source, those of an
   extra are skipped. Then with all extras.
3. Extras one after the other beside the wheel, once: their tests run. The source distribution,
   once, and there the tests of the project itself as well.
4. The wheel with the lowest versions that `pyproject.toml` allows, on the lowest Python.
5. The licences of everything that comes along, into `docs/reference/licences.md`.

Runs in an environment with `build`, `packaging` and `uv`. Tests are those of a few wings that reach
every dependency; ``--all`` runs all fast ones.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
# Files, numbers, sampling, pages, the command line: each dependency is used by one of these.
TESTS = (
    *(
        "tests/camera",
        "tests/observations",
        "tests/core/test_cluster.py",
        "tests/images/test_centroids.py",
    ),
    *(
        "tests/sky/test_catalogue.py",
        "tests/likelihood/test_sums.py",
        "tests/inference/test_arviz.py",
    ),
    *(
        "tests/inference/test_sample.py",
        "tests/budgeting/test_budget.py",
        "tests/runs/test_stored_previous.py",
    ),
    *(
        "tests/presentation/test_figures.py",
        "tests/cli/test_commands.py",
        "tests/cli/test_schemas.py",
        "tests/core/test_extras.py",
    ),
)
# What tests need beside the package, and extras that are tried by themselves.
TOOLS = ("pytest", "hypothesis", "jsonschema")
EXTRAS = ("images", "cluster", "excel", "notebook")
PARTS = ("wheel", "extras", "sdist", "lowest", "licences")
# What is under version control and stays at home.
HOME = re.compile(r"\.ci/|\.git")


def say(message: str) -> None:
    print(f"--- {message}", flush=True)


def run(*command: str | Path, cwd: Path = ROOT) -> str:
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "VIRTUAL_ENV")
    }
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, text=True, stdout=subprocess.PIPE
    )
    if done.returncode:
        print(done.stdout)
        raise SystemExit(f"failed: {' '.join(str(part) for part in command)}")
    return done.stdout


def interpreter(version: str) -> Path | None:
    """An interpreter of a version that runs; a name on PATH may be a shim for one that is not
    installed.
    """
    home = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    known = [
        shutil.which(f"python{version}"),
        *sorted(home.glob(f"versions/{version}.*/bin/python")),
    ]
    for candidate in (str(path) for path in known if path):
        if (
            subprocess.run([candidate, "-c", "import ensurepip"], capture_output=True).returncode
            == 0
        ):
            return Path(candidate)
    return None


def environment(folder: Path, python: Path, constraints: Path, *what: str) -> Path:
    """An empty environment with `what` in it, and its interpreter."""
    run("uv", "venv", "--quiet", "--clear", "--python", python, folder)
    inside = folder / "bin" / "python"
    install(inside, constraints, *what)
    return inside


def install(inside: Path, constraints: Path, *what: str) -> None:
    run("uv", "pip", "install", "--quiet", "--python", inside, "--constraint", constraints, *what)


def unpacked(archive: Path, folder: Path, package: bool) -> Path:
    """The source distribution in a folder, with or without the package."""
    with tarfile.open(archive) as source:
        source.extractall(folder, filter="data")
    (tree,) = folder.iterdir()
    if not package:
        shutil.rmtree(tree / "starcal_uq")
    return tree


def tested(python: Path, tree: Path, tests: tuple[str, ...], *options: str) -> None:
    where = run(python, "-c", "import starcal_uq; print(starcal_uq.__file__)", cwd=tree).strip()
    options = ("-m", "not slow", *options)
    out = run(python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options, *tests, cwd=tree)
    say(f"{out.strip().splitlines()[-1]}; tested: {where}")


def contents(archives: dict[str, Path]) -> None:
    """Nothing that is needed is missing, nothing else is in them."""
    kept = run("git", "ls-files").split()
    wanted = {"sdist": {name for name in kept if not HOME.match(name)} | {".gitignore", "PKG-INFO"}}
    wanted["wheel"] = {name for name in kept if name.startswith("starcal_uq/")}
    with tarfile.open(archives["sdist"]) as archive:
        held = {"sdist": {name.partition("/")[2] for name in archive.getnames()}}
    with zipfile.ZipFile(archives["wheel"]) as wheel:
        held["wheel"] = {name for name in wheel.namelist() if ".dist-info/" not in name}
        assert any(name.endswith("dist-info/licenses/LICENSE") for name in wheel.namelist())
    for kind, names in wanted.items():
        if names != held[kind]:
            raise SystemExit(
                f"{kind}: missing {sorted(names - held[kind])}, too much "
                f"{sorted(held[kind] - names)}"
            )
        say(
            f"{kind}: {len(names)} files, {archives[kind].stat().st_size / 1e6:.1f} MB, none "
            "missing, none too much"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Tests what users install.")
    parser.add_argument("--all", action="store_true", help="all fast tests on each Python")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS, help="parts to do, instead of all"
    )
    parser.add_argument("--python", nargs="+", default=PYTHONS, help="versions of Python")
    parser.add_argument(
        "--keep",
        type=Path,
        help="folder for environments and trees, kept (default: a temporary one)",
    )
    options = parser.parse_args()
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with tempfile.TemporaryDirectory(prefix="starcal-supply-") as temporary:
        work = (options.keep or Path(temporary)).resolve()
        dist = work / "dist"
        shutil.rmtree(dist, ignore_errors=True)
        run(sys.executable, "-m", "build", "--outdir", dist, ROOT)
        archives = {"sdist": next(dist.glob("*.tar.gz")), "wheel": next(dist.glob("*.whl"))}
        contents(archives)
        pythons = {
            version: found
            for version in options.python
            if (found := interpreter(version)) is not None
        }
        for version in set(options.python) - set(pythons):
            say(f"Python {version} was not found and is not tested")
        shutil.rmtree(work / "tests", ignore_errors=True)
        shutil.rmtree(work / "source", ignore_errors=True)
        tests = unpacked(archives["sdist"], work / "tests", package=False)
        source = unpacked(archives["sdist"], work / "source", package=True)
        # Tests of the project read its source; one call is checked by mypy, which `make test` does.
        chosen = ("tests", "--ignore=tests/test_project.py") if options.all else TESTS
        pins, wheel = ROOT / "constraints.txt", str(archives["wheel"])

        def emptied(name: str, said: str, version: str, limits: Path, *what: str) -> Path:
            say(f"{said}, Python {version}")
            return environment(work / name, pythons[version], limits, *what)

        if "wheel" in options.only:
            for version in pythons:
                plain = emptied(
                    f"plain-{version}", "wheel without extras", version, pins, wheel, *TOOLS
                )
                tested(plain, tests, chosen)
                tested(
                    emptied(
                        f"all-{version}",
                        "wheel with all extras",
                        version,
                        pins,
                        f"{wheel}[all,test]",
                    ),
                    tests,
                    chosen,
                )
        lowest = next(iter(pythons))
        if "extras" in options.only:
            plain = emptied("extras", "wheel alone, then extras", lowest, pins, wheel, *TOOLS)
            for extra in EXTRAS:
                say(f"wheel with {extra} and those before it, Python {lowest}")
                install(plain, pins, f"{wheel}[{extra}]")
                tested(plain, tests, chosen, "-m", "extra and not slow")
        if "sdist" in options.only:
            built = emptied(
                "sdist", "source distribution", lowest, pins, f"{archives['sdist']}[test]"
            )
            tested(
                built,
                source,
                ("tests/test_project.py", "tests/test_benchmarks.py", "tests/observations"),
            )
        if "lowest" in options.only:
            limits = work / "lowest.txt"
            extras = [f"--extra={name}" for name in (*EXTRAS, "asdf", "compiled", "tetra3rs")]
            lowered = ("--resolution", "lowest-direct", "--python", pythons[lowest], *extras)
            run(
                "uv",
                "pip",
                "compile",
                "--quiet",
                *lowered,
                "pyproject.toml",
                "--output-file",
                limits,
            )
            low = emptied("lowest", "lowest versions", lowest, limits, f"{wheel}[test]")
            # Old versions are out of date by what came after them.
            tested(low, tests, chosen, "-W", "ignore::DeprecationWarning")
        if "licences" in options.only:
            found = [
                emptied(f"users-{v}", "what users get", v, pins, f"{wheel}[all]") for v in pythons
            ]
            run(sys.executable, ROOT / "scripts" / "licences.py", *found)
            say("licences: docs/reference/licences.md")


if __name__ == "__main__":
    main()
