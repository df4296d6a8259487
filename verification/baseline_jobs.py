"""The jobs of `baseline.py`: small commands that together touch whatever the product does."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Job:
    """Commands that are run one after the other in a folder of their own.

    A line is a command of the product without its name, or begins with ``python`` (code for the
    interpreter) or ``file`` (a name, and its content), or is ``NAME=VALUE`` (for the environment of
    the lines after it). ``{seed}`` is the seed. `data` names files of the real data, which are
    copied into the folder first and removed at the end.
    """

    name: str
    lines: tuple[str, ...]
    data: tuple[str, ...] = ()


CAMERA = """[camera]
name = "small tracker"
width_px = 1024
height_px = 1024
pixel_um = 12.0
focal_mm = 70.2
x0_px = 515.0
y0_px = 506.0
distortion = "brown"
k1 = 2.0e-10
k2 = -3.5e-15
"""
NOMINAL = CAMERA.replace("70.2", "70.5").replace("515.0", "511.5").replace("506.0", "511.5")
NOMINAL = NOMINAL.replace("2.0e-10", "0.0").replace("-3.5e-15", "0.0")
CAMERAS = (f"file true.toml\n{CAMERA}", f"file camera.toml\n{NOMINAL}")
STARS = (*CAMERAS, "simulate true.toml -o stars.ecsv --frames 40 --seed {seed}")
BUDGET = """[budget]
title = "Small tracker"

[[requirement]]
name = "knowledge across the boresight"
axis = "cross-boresight"
limit_arcsec = 1.0
confidence = 0.997
scope = "after alignment"
interpretation = "mixed"
"""
# Wrong rows, which the product names.
DAMAGED = """python
import csv
rows = list(csv.reader(open("stars.csv")))
x, ra, frame = (rows[0].index(name) for name in ("x_px", "ra_deg", "frame"))
def put(name, change):
    made = [list(row) for row in rows]
    change(made)
    csv.writer(open(name, "w", newline="")).writerows(made)
put("text.csv", lambda made: made[3].__setitem__(x, "left"))
put("nan.csv", lambda made: made[3].__setitem__(x, "nan"))
put("outside.csv", lambda made: made[3].__setitem__(x, "5000"))
put("angle.csv", lambda made: made[3].__setitem__(ra, "400"))
put("names.csv", lambda made: made[0].__setitem__(x, "column"))
put("twice.csv", lambda made: made.extend([*row] for row in rows if row[frame] == "1"))
def again(made):
    made.extend([*row[:frame], "900", *row[frame + 1:]] for row in rows if row[frame] == "1")
put("repeated.csv", again)
def wrong(made):
    for row in made[1::9]:
        row[x] = str((float(row[x]) + 400.0) % 1000.0)
put("wrong.csv", wrong)
put("few.csv", lambda made: made.__delitem__(slice(12, None)))
put("empty.csv", lambda made: made.__delitem__(slice(1, None)))
"""
SHRINK = """python
import re, pathlib
for path in pathlib.Path(".").glob("*.toml"):
    text = path.read_text()
    text = re.sub(r"^seeds = \\d+", "seeds = 2", text, flags=re.M)
    text = re.sub(r"\\bn = \\d+", "n = 2", text)
    ends = r"^(distortion_px|stars) = \\[([^,]+),.*,([^,]+)\\]"
    text = re.sub(ends, r"\\1 = [\\2,\\3]", text, flags=re.M)
    path.write_text(text)
"""
# What a notebook shows, by the public names alone.
NOTEBOOK = """python
import pathlib
import warnings
import numpy as np
import starcal_uq as sc
warnings.simplefilter("always")
warnings.showwarning = lambda message, category, *rest: print(f"{{category.__name__}}: {{message}}")
def show(name, thing):
    print(f"--- {{name}}")
    print(repr(thing))
    print(getattr(thing, "text", ""))
    pathlib.Path(f"{{name}}.html").write_text(getattr(thing, "_repr_html_", str)())
    if hasattr(thing, "to_dataframe"):
        thing.to_dataframe().to_csv(f"{{name}}.csv")
obs, camera = sc.load_observations("stars.ecsv"), sc.Camera.load("camera.toml")
show("observations", obs)
show("camera", camera)
for name, options in {{
    "plain": {{}},
    "k1": {{"model": "k1"}},
    "robust": {{"effects": "tails"}},
    "noise": {{"effects": "noise"}},
    "stars": {{"effects": "star"}},
    "three_stage": {{"method": "three_stage"}},
}}.items():
    cal = sc.calibrate(obs, camera, **options)
    show(name, cal)
    cal.save(f"{{name}}.json")
    arrays = {{name: getattr(cal, name) for name in ("theta", "covariance", "residuals_px")}}
    np.savez(f"{{name}}_arrays.npz", **arrays)
cal = sc.calibrate(obs, camera)
post = sc.sample(obs, cal, seed={seed}, n_ensembles=2, n_walkers=16, n_steps=60)
show("posterior", post)
show("coupling", sc.coupling(post))
show("attitude", sc.propagate(post, obs, seed={seed}, n_draws=60))
show("diagnosis", sc.diagnose(obs, cal, post, seed={seed}))
show("catalogue", sc.load_catalogue())
"""
SURFACE = """python
import contextlib, importlib, inspect, io, json, pkgutil
import starcal_uq as sc
def described(thing):
    if inspect.isclass(thing):
        members = {{}}
        for name, member in inspect.getmembers(thing):
            if name.startswith("_") and name != "__init__":
                continue
            member = inspect.unwrap(member) if callable(member) else member
            members[name] = signature(member) if callable(member) else type(member).__name__
        fields = list(getattr(thing, "__dataclass_fields__", ()))
        return {{"class": signature(thing), "members": members, "fields": fields}}
    return signature(thing) if callable(thing) else type(thing).__name__
def signature(thing):
    try:
        return str(inspect.signature(thing))
    except (TypeError, ValueError):
        return "callable"
def names(module):
    return [n for n in getattr(module, "__all__", dir(module)) if not n.startswith("_")]
# A name that moves to another wing is the same name.
found = {{}}
def take(where, module):
    for name in names(module):
        thing = getattr(module, name)
        entry = found.setdefault(name, {{"what": described(thing), "wings": []}})
        entry["wings"].append(where)
take("starcal_uq", sc)
for wing in pkgutil.iter_modules(sc.__path__):
    if wing.ispkg and not wing.name.startswith("_") and wing.name != "cli":
        take(wing.name, importlib.import_module(f"starcal_uq.{{wing.name}}"))
json.dump(found, open("names.json", "w"), indent=1, sort_keys=True, default=str)
"""
# The help of each command, and the options in it.
HELP = """python
import json, os, re, subprocess, sys
words = [sys.executable, "-m", "starcal_uq"]
def said(*arguments):
    wide = os.environ | {{"COLUMNS": "400"}}
    return subprocess.run([*words, *arguments], env=wide, capture_output=True, text=True).stdout
def flat(text):
    return re.sub(r"[ \\u2500]{{2,}}", "  ", text)
main = said("--help")
commands = re.findall(r"^\\u2502 ([a-z][a-z-]+)  ", main, flags=re.M)
open("help.txt", "w").write(flat(main))
options = {{}}
for command in commands:
    text = said(command, "--help")
    open(f"help-{{command}}.txt", "w").write(flat(text))
    options[command] = sorted(set(re.findall(r"^\\u2502[ *]+(--?[a-z][a-z-]*)", text, flags=re.M)))
json.dump(options, open("options.json", "w"), indent=1)
"""
SAMPLER = "--ensembles 2 --walkers 16 --steps 60"
WRONG = "text nan outside angle names twice repeated wrong few empty absent"
FORMATS = (
    "opencv ros kalibr mrcal tetra3rs tetra3 sip asdf covariance csv netcdf arviz latex markdown"
)
ESA = "esa_tetra3_camera.toml"

JOBS = (
    Job("surface", (SURFACE, HELP, "schema", "--version")),
    Job("demo", ("demo --frames 30 --seed {seed} --out demo",)),
    Job(
        "table",
        (
            "new example -o .",
            f"run stars.ecsv camera.toml -o first --seed {{seed}} {SAMPLER}",
            "run stars.ecsv camera.toml -o run --site site.toml --effects auto,noise --screen --seed {seed}",
            "run stars.ecsv camera.toml -o json --site site.toml --effects auto,tails"
            f" --seed {{seed}} {SAMPLER} --json",
            "calibrate stars.ecsv camera.toml -o screened --site site.toml --screen",
            "report run --notebook --force",
        ),
    ),
    Job(
        "measured",
        (
            "new example -o example",
            f"run esa_tetra3_observations.csv {ESA} -o run --directions catalogue --site example/site.toml"
            " --time 2019-07-29T20:47:26 --effects auto,noise --seed {seed}",
            f"calibrate esa_tetra3_observations.csv {ESA} -o apparent --directions apparent"
            " --column ra_deg=ra_apparent_deg --column dec_deg=dec_apparent_deg --only-frames 0-5 --model k1",
        ),
        ("esa_tetra3_observations.csv", ESA),
    ),
    Job(
        "images",
        (
            "new example -o example",
            f"run esa-tetra3 {ESA} -o run --site example/site.toml --seed {{seed}}",
            "inspect run -o run/frames.html",
            f"run esa-tetra3 -o blind --pixel-um 6.9 --seed {{seed}} {SAMPLER}",
            "centroid esa-tetra3 -o centroids.parquet",
            f"identify centroids.parquet {ESA} -o identified.csv",
        ),
        ("esa-tetra3", ESA),
    ),
    Job("plan", (*CAMERAS, "plan camera.toml --target-arcsec 5 --choose 5 --seed {seed} -o plan")),
    Job(
        "compare",
        (
            *STARS,
            "calibrate stars.ecsv camera.toml -o run",
            "compare run --split odd-even --seed {seed} -o split",
            "calibrate stars.ecsv camera.toml -o one --only-frames 0-19",
            "calibrate stars.ecsv camera.toml -o two --only-frames 20-39",
            "compare one two --json",
        ),
    ),
    Job(
        "validate",
        (
            *CAMERAS,
            "validate camera.toml --replicates 20 --frames 10 --workers 1 --seed {seed} -o validation",
        ),
    ),
    Job(
        "study",
        (
            *(
                f"new study --template {name} -o {name}.toml"
                for name in (
                    "fov-distortion",
                    "frames-stars",
                    "magnitude-noise",
                    "distortion-models",
                )
            ),
            SHRINK,
            *(
                f"study {name}.toml -o {name} --workers 0 --seed {{seed}}"
                for name in (
                    "fov-distortion",
                    "frames-stars",
                    "magnitude-noise",
                    "distortion-models",
                )
            ),
        ),
    ),
    Job(
        "merge",
        (
            *STARS,
            "calibrate stars.ecsv camera.toml -o one --only-frames 0-19",
            "calibrate stars.ecsv camera.toml -o two --only-frames 20-39",
            "merge one two -o both",
            "merge one two -o own --noise own --json",
            "coupling both",
            "merge one one -o same",
        ),
    ),
    Job("reproduce", ("reproduce -o paper --replicates 8 --frames 20 --workers 1 --seed {seed}",)),
    Job(
        "field", ("reproduce-field -o field --frames 20 --replicates 20 --workers 1 --seed {seed}",)
    ),
    Job(
        "partitions",
        (
            *CAMERAS,
            "simulate true.toml -o parts --frames 60 --partition-frames 20 --workers 0 --seed {seed}",
            "calibrate parts camera.toml -o run --workers 0",
            f"sample run --seed {{seed}} {SAMPLER}",
            "coupling run",
            "propagate run --seed {seed} --draws 60",
            "diagnose run --seed {seed}",
            "report run",
            "calibrate parts camera.toml -o noise --workers 0 --effects noise",
            "calibrate parts camera.toml -o robust --workers 0 --effects tails",
            "calibrate parts camera.toml -o stars --workers 0 --effects star",
        ),
    ),
    *(
        Job(
            f"loops-{path}",
            (
                f"STARCAL_UQ_KERNELS={path}",
                *STARS,
                "calibrate stars.ecsv camera.toml -o common",
                "calibrate stars.ecsv camera.toml -o noise --effects noise",
                "calibrate stars.ecsv camera.toml -o robust --effects tails",
                "calibrate stars.ecsv camera.toml -o stars --effects star",
                "calibrate stars.ecsv camera.toml -o star_noise --effects star,noise",
                "calibrate stars.ecsv camera.toml -o three --method three_stage",
                "calibrate stars.ecsv camera.toml -o inverse --model inverse",
                *(
                    f"sample {run} --seed {{seed}} {SAMPLER}"
                    for run in ("common", "noise", "robust", "stars")
                ),
                f"sample star_noise --evaluation exact --seed {{seed}} {SAMPLER}",
                "diagnose common --seed {seed} --starts 2",
                "diagnose stars --seed {seed} --starts 2",
            ),
        )
        for path in ("numpy", "numba")
    ),
    Job(
        "likelihoods",
        (
            *STARS,
            *(
                f"calibrate stars.ecsv camera.toml -o {method} --method {method}"
                for method in ("least_squares", "samaan", "griffith")
            ),
            "simulate true.toml -o plain.csv --frames 40 --seed {seed}",
            *(
                f"calibrate stars.ecsv camera.toml -o {name} --solver {name}"
                for name in ("minpack", "ipopt")
            ),
            "calibrate plain.csv camera.toml -o tangential --model brown_tangential --directions apparent",
            "calibrate stars.ecsv camera.toml -o run --screen --start x0_px=500",
            f"sample run --likelihood pairs --seed {{seed}} {SAMPLER}",
            f"sample run --likelihood pairs_naive --seed {{seed}} {SAMPLER} --force",
            f"sample run --likelihood student_t --dof free --seed {{seed}} {SAMPLER} --force",
            f"sample run --evaluation exact --sigma 0.05 --seed {{seed}} {SAMPLER} --force",
            f"sample run --evaluation compressed --moves stretch --seed {{seed}} {SAMPLER} --force",
            "filter plain.csv camera.toml -o griffith_stream --method griffith --parameters all",
            "filter plain.csv camera.toml -o samaan_stream --method samaan --parameters optics --sigma 0.05",
        ),
    ),
    Job(
        "budget",
        (
            *STARS,
            f"file budget.toml\n{BUDGET}",
            f"run stars.ecsv camera.toml -o run --seed {{seed}} {SAMPLER} --draws 60",
            "budget run --seed {seed}",
            "budget run --template mission.toml",
            "budget run --budget mission.toml --seed {seed} -o b.csv -o b.tex -o b.html --force",
            "budget run --budget budget.toml --seed {seed} --json",
            *(f"export run --to {name} -o export.{name}" for name in FORMATS.split()),
            "coupling run --json",
            "propagate run --json --force --seed {seed} --draws 60 --alignment observed",
        ),
    ),
    Job("notebook", (*STARS, NOTEBOOK)),
    Job(
        "faults",
        (
            *CAMERAS,
            "simulate true.toml -o stars.csv --frames 8 --seed {seed}",
            DAMAGED,
            *(f"calibrate {name}.csv camera.toml -o {name} --in-space" for name in WRONG.split()),
            "calibrate wrong.csv camera.toml -o screened --in-space --screen",
            "calibrate repeated.csv camera.toml -o dropped --in-space --duplicates drop --json",
            "calibrate stars.csv camera.toml -o run --directions catalogue",
            "calibrate stars.csv camera.toml -o run --model brown9",
            "calibrate stars.csv camera.toml -o run --method samaan --effects tails",
            "calibrate camera.toml stars.csv -o run",
            "calibrate stars.csv camera.toml -o three --only-frames 0-2 --model brown_tangential --json",
            "sample nowhere",
            "new camera -o new.toml",
            "new site -o site.toml --near 52 4",
            "new budget -o budget.toml",
        ),
    ),
)
