"""Limits of settings: every public function refuses what lies outside, with the sentence of the command line."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.core import settings
from starcal_uq.core.errors import SettingError, StarcalError
from starcal_uq.core.settings import LIMITS, Limit, bounded

PACKAGE = Path(sc.__file__).parent


def public_functions():
    """Functions and methods of the stubs, by their full names."""
    for stub in sorted(PACKAGE.rglob("__init__.pyi")):
        wing = importlib.import_module(".".join(stub.parent.relative_to(PACKAGE.parent).parts))
        for name in re.findall(r"import \w+ as (\w+)", stub.read_text()):
            public = getattr(wing, name)
            members = inspect.getmembers(public, inspect.isfunction) if inspect.isclass(public) else [("", public)]
            for member, function in members:
                if inspect.isfunction(function) and not member.startswith("_"):
                    yield f"{name}.{member}".rstrip("."), function


def test_every_public_function_refuses_settings_outside_their_limits():
    """Before it looks at anything else: other arguments are missing here."""
    found = set()
    for name, function in public_functions():
        # An array of one number for each star, and the Julian year of a catalogue, are judged where they are read.
        for setting in set(inspect.signature(function).parameters) & set(LIMITS) - {"sigma_px"}:
            limit = LIMITS[setting]
            for odd in (limit.low - 1, 10**30, -(10**30), float("nan"), float("inf"), "three"):
                with pytest.raises(SettingError, match=f"^{setting} is .*: give a (whole )?number from "):
                    function(**{setting: odd})
            found.add((name, setting))
    assert len(found) > 60 and {("sample", "seed"), ("simulate", "n_frames"), ("Run.propagate", "seed")} <= found


def test_errors_of_settings_are_errors_of_values():
    with pytest.raises(ValueError, match=r"^seed is -1: give a whole number from 0 to 18446744073709551615\.$"):
        sc.simulate(None, None, seed=-1)
    with pytest.raises(StarcalError, match="n_frames is 0: give a whole number from 1 to 1000000000"):
        sc.simulate(None, None, n_frames=0)


def test_counts_that_no_memory_holds_are_refused_before_it_is_taken(monkeypatch):
    with pytest.raises(
        SettingError, match=r"^n_frames=1000000000, min_stars=10000: the result needs 5.6e\+05 GB of memory"
    ):
        sc.simulate(None, None, n_frames=10**9, min_stars=10**4)
    settings.check_memory("n_steps=1", 8.0)
    # A system that does not tell how much it has refuses nothing.
    monkeypatch.delattr("os.sysconf")
    settings.check_memory("n_steps=1", 1e30)


def test_numbers_of_any_type_are_judged_and_others_left_alone():
    whole, real = Limit(1, 9), Limit(0.5, 2.0, whole=False)
    assert all(map(whole.holds, (1, 9, np.int64(3), (1, 2), [9], None, np.arange(3), np.random.SeedSequence(1))))
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

    assert model_names() == get_args(settings.ModelName)
    assert tuple(SCOPES) == get_args(settings.Scope)
    assert tuple(CONVENTIONS) == get_args(settings.Convention)
    assert tuple(READINGS) == get_args(settings.FieldReading)
