"""Limits of settings: every public function refuses what lies outside."""

import inspect
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.camera.distortion import get_model
from starcal_uq.core import settings
from starcal_uq.core.errors import SettingError, StarcalError
from starcal_uq.core.settings import LIMITS, Limit, bounded
from starcal_uq.studies import StudyDefinition
from starcal_uq.studies.axes import AXES, SENSOR_AXES
from starcal_uq.studies.definition import _STUDY
from tests.helpers.public import public_functions

PACKAGE = Path(sc.__file__).parent


def test_every_public_function_refuses_settings_outside_their_limits():
    """Before it looks at anything else: other arguments are missing here."""
    found = set()
    for name, function in public_functions():
        # An array of one number for each star, and the Julian year of a catalogue, are judged where
        # they are read.
        for setting in set(inspect.signature(function).parameters) & set(LIMITS) - {"sigma_px"}:
            limit = LIMITS[setting]
            for odd in (limit.low - 1, 10**30, -(10**30), float("nan"), float("inf"), "three"):
                with pytest.raises(
                    SettingError, match=f"^{setting} is .*: give a (whole )?number from "
                ):
                    function(**{setting: odd})
            found.add((name, setting))
    assert (
        len(found) > 60
        and {("sample", "seed"), ("simulate", "n_frames"), ("Run.propagate", "seed")} <= found
    )


def test_errors_of_settings_are_errors_of_values():
    assert issubclass(SettingError, ValueError) and issubclass(SettingError, StarcalError)


def test_counts_that_no_memory_holds_are_refused_before_it_is_taken(monkeypatch):
    with pytest.raises(SettingError, match=r"^n_frames=1000000000, min_stars=10000: the result"):
        sc.simulate(None, None, n_frames=10**9, min_stars=10**4)
    settings.check_memory("n_steps=1", 8.0)
    # A system that does not tell how much it has refuses nothing.
    monkeypatch.delattr("os.sysconf")
    settings.check_memory("n_steps=1", 1e30)


def test_numbers_of_any_type_are_judged_and_others_left_alone():
    whole, real = Limit(1, 9), Limit(0.5, 2.0, whole=False)
    assert all(
        map(
            whole.holds,
            (1, 9, np.int64(3), (1, 2), [9], None, np.arange(3), np.random.SeedSequence(1)),
        )
    )
    assert not any(map(whole.holds, (0, 10, 3.0, np.float64(3.0), "3", (1, 0), np.int8(-1))))
    assert all(map(real.holds, (0.5, 1, np.float32(2.0), None)))
    assert not any(map(real.holds, (np.nan, np.inf, 0.4999, "1", [1.0, 3.0])))


def test_control_an_unbounded_function_takes_anything():
    def unbounded(seed):
        return seed

    assert unbounded(seed=-1) == -1
    with pytest.raises(SettingError):
        bounded(unbounded)(-1)


def test_words_with_explanations_are_those_of_the_lists():
    from starcal_uq.camera.distortion import model_names
    from starcal_uq.paper.camera import CONVENTIONS
    from starcal_uq.paper.field.published import READINGS
    from starcal_uq.planning.forecast import SCOPES

    assert model_names(axes=True) == get_args(settings.ModelName)
    assert tuple(SCOPES) == get_args(settings.Scope)
    assert tuple(CONVENTIONS) == get_args(settings.Convention)
    assert tuple(READINGS) == get_args(settings.FieldReading)


ODD = (-1, 0, 10**30, -1.0, 0.0, float("nan"), float("inf"), -float("inf"), 1e-300, 1e300)
STUDY = {"study": {"geometries": 20}, "observation": {"frames": 20}, "sweep": {"noise_mag": [6.0]}}


def study_files():
    """A study with an odd number under each key that holds one, wherever that may stand; with its
    name.
    """
    camera = sc.paper.paper_camera().to_dict()

    def file(**tables):
        return {**STUDY, "camera": camera} | tables

    numbers = [name for name, axis in AXES.items() if axis.kind != "name"]
    keys = [name for name, key in _STUDY.keys.items() if {"ge", "le"} <= set(key.bounds)]
    for odd in ODD:
        for name in numbers:
            yield (
                name,
                odd,
                file(observation={"frames": 20} | {name: odd}, sweep={"direction_mas": [1.0]}),
            )
            yield name, odd, file(sweep={name: [odd]})
            for spacing in ("linear", "log"):
                for end in ("start", "stop"):
                    span = {"start": 3, "stop": 5, "spacing": spacing} | {end: odd}
                    yield name, odd, file(sweep={name: span | {"n": 2}})
                    yield name, odd, file(sweep={"latin": {"n": 2, name: span}})
        for name in (*keys, "seeds", "target_sigma"):
            yield name, odd, file(study={name: {"f": odd} if name == "target_sigma" else odd})
        for name in ("width_px", "height_px", "pixel_um", "focal_mm", "x0_px", "y0_px", "k1", "k2"):
            yield name, odd, file(camera=camera | {name: odd})
        yield "seeds", odd, file(study={"seeds": [odd]})
        yield "n", odd, file(sweep={"sigma_px": {"start": 0.1, "stop": 0.2, "n": odd}})
        yield "n", odd, file(sweep={"latin": {"n": odd, "sigma_px": {"start": 0.1, "stop": 0.2}}})


@pytest.mark.slow
def test_odd_numbers_in_a_study_are_refused_in_a_sentence_or_make_sense():
    """Every key and axis that is declared."""
    refused, taken = set(), []
    for name, odd, content in study_files():
        try:
            made = StudyDefinition.from_dict(content)
        except StarcalError as error:
            assert re.match(r"study[:,] .*[.?]$", str(error)) and "\n" not in str(error), (
                name,
                odd,
                str(error),
            )
            assert len(str(error)) < 400
            refused.add((name, odd))
        else:
            taken.append((name, odd))
            assert len(made.axes) > 0 and made.n_cells < 10**7
    assert {name for name, odd in refused if odd == 1e300} == {name for name, _ in refused}
    assert {odd for name, odd in refused if name == "frames"} >= {-1, 0, 10**30, 1e300}
    assert len(refused) > 200 and len(taken) > 50


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, axis in AXES.items() if axis.kind != "name"])
def test_cells_at_the_limits_of_an_axis_have_numbers_or_a_reason(name):
    """Warnings are errors here: nothing overflows on the way."""
    limit = AXES[name].limit
    content = {**STUDY, "camera": sc.paper.paper_camera().to_dict(), "sweep": {name: [limit.low]}}
    if name not in ("frames", "max_mag"):
        content["sweep"][name].append(limit.high)
    models = {"k3": "brown3", "p1": "brown_tangential", "p2": "brown_tangential"}
    models |= dict.fromkeys(("stretch", "skew"), "brown+axes")
    models |= dict.fromkeys(("s1", "s2"), "thin_prism") | {"k4": "fisheye"}
    models |= {c.name: "cubic" for c in get_model("cubic").lens}
    bare = sc.paper.paper_camera().replace(distortion="none", coefficients=())
    content["camera"] = bare.to_dict() | {"distortion": models.get(name, "brown")}
    if name in SENSOR_AXES:
        content["sensor"] = {}
    found = sc.study(StudyDefinition.from_dict(content), workers=0)
    assert found.ok.sum() + sum(found.problems.values()) == found.n_cells
    assert not found.ok.any() or np.isfinite(found.values("sigma", parameter="f")[found.ok]).all()
