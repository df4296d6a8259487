"""Findings are facts: every code is worded in one table, and no wing below presentation words
one.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from enum import Enum
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import jinja2
import numpy as np
import pytest

from starcal_uq.attitude.profile import Steps
from starcal_uq.budgeting.budget import Remark
from starcal_uq.budgeting.totals import Difference
from starcal_uq.calibration.cameras import Mixed
from starcal_uq.calibration.noise_floor import Floor
from starcal_uq.calibration.plausibility import Slip
from starcal_uq.calibration.screening.result import Rejections
from starcal_uq.comparison.compare import Differs
from starcal_uq.comparison.covariance import Basis
from starcal_uq.core import status
from starcal_uq.core.settings import Scope
from starcal_uq.diagnostics.verdict.limits import Limit
from starcal_uq.diagnostics.verdict.remedies import Refusal
from starcal_uq.estimation.duplicates import Repeats
from starcal_uq.estimation.effects import Refused
from starcal_uq.estimation.merging import Apart
from starcal_uq.estimation.undetermined import Open
from starcal_uq.inference.power_scaling import CONFLICT, WEAK
from starcal_uq.inference.priors import Stated
from starcal_uq.likelihood.noise_model import Noise
from starcal_uq.pipeline.images import Told
from starcal_uq.presentation.figures import planning
from starcal_uq.presentation.words import sentences
from starcal_uq.presentation.words.sentences import CompiledTemplates, templates, told
from starcal_uq.sky.apparent import Horizon

PACKAGE = Path(status.__file__).parents[1]
WORDS = PACKAGE / "presentation" / "words"
# Wings that show findings, or stand above those that do.
ABOVE = ("presentation", "runs", "paper", "cli")
MAKERS = ("Check", "judged", "Order", "Finding", "clause")
KINDS = {
    *(status.Code, status.Advice, status.Note, Difference, Limit, Refusal, Slip, Mixed, Open),
    *(Basis, Differs, Apart, Rejections, Noise, Remark, Floor, Steps, Told, Repeats, Stated),
    *(Horizon, Refused),
}


def test_figures_and_sentences_name_the_parts_of_an_attitude_error_alike() -> None:
    assert set(sentences.SCOPE_NAMES) == set(get_args(Scope))
    assert planning.SCOPE_NAMES is sentences.SCOPE_NAMES


def made(tree: ast.AST) -> Iterator[ast.Call]:
    """The calls of a module that make findings."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in MAKERS:
            yield node


@cache
def below() -> list[tuple[str, ast.Module]]:
    """The modules of the wings below presentation that make findings."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        place, text = path.relative_to(PACKAGE), path.read_text(encoding="utf-8")
        if place.parts[0] not in ABOVE and any(f"{maker}(" in text for maker in MAKERS):
            found.append((str(place), ast.parse(text)))
    return found


def worded(tree: ast.AST) -> list[str]:
    """Texts of several words in the calls that make findings; titles are names of the user's."""
    found = []
    for call in made(tree):
        inside = [*call.args, *(word.value for word in call.keywords if word.arg != "title")]
        for node in (node for part in inside for node in ast.walk(part)):
            if isinstance(node, ast.Constant) and " " in str(node.value):
                found.append(str(node.value))
        found += [word.arg or "" for word in call.keywords if word.arg in ("told", "sentence")]
    return found


def test_every_code_has_a_sentence() -> None:
    codes = {f"{kind.__name__}.{code.name}" for kind in KINDS for code in kind}
    assert codes - templates().keys() == set()
    # Nor does the table hold a code that is gone.
    own = {name for name in templates() if name.partition(".")[0] in {k.__name__ for k in KINDS}}
    assert own == codes
    # Codes of an enumeration of which none is worded.
    names = {
        node.value.id
        for _, tree in below()
        for call in made(tree)
        for node in ast.walk(call)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.attr.isupper()
    }
    assert names - {kind.__name__ for kind in KINDS} <= {"Level", "Status"}
    assert {kind.__name__ for kind in KINDS} <= names


def test_no_two_templates_have_one_name() -> None:
    tables = [tomllib.loads(path.read_text("utf-8")) for path in WORDS.glob("*.toml")]
    own = [name for name in templates() if not name.startswith("Heads.")]
    assert sum(len(entries) for table in tables for entries in table.values()) == len(own)


def test_a_code_without_words_is_noticed() -> None:
    class Unknown(Enum):
        NEW = 1

    with pytest.raises(LookupError):
        _ = status.Finding(Unknown.NEW).sentence


def test_no_wing_below_presentation_words_a_finding() -> None:
    assert {place: found for place, tree in below() if (found := worded(tree))} == {}


@pytest.mark.parametrize(
    "source",
    [
        'Finding(Note.A, {"why": "two words"})',
        'Order(Advice.A, {"why": f"{x} px"})',
        "Check(Code.A, level=level, told=words)",
    ],
)
def test_words_in_a_finding_are_noticed(source: str) -> None:
    assert worded(ast.parse(source))
    # Control: facts, and the name that a user gave.
    assert not worded(ast.parse('Check(Code.A, {"size_px": 2.0}, title=f"Requirement {x}")'))


def test_advice_is_an_order_and_values_are_put_in() -> None:
    for code in status.Advice:
        if code not in (
            status.Advice.LOOK_FOR_THE_CAUSE,
            status.Advice.MEND_THE_ESTIMATE,
            status.Advice.STATE_WHAT_IS_MISSING,
            status.Advice.REDUCE_OR_RELAX,
        ):
            said = status.Order(code).sentence
            assert said[0].isupper() and said.endswith("."), said
    missing = status.Order(status.Advice.STATE_WHAT_IS_MISSING, {"missing": ("a", "b")})
    assert missing.sentence == "State in the budget file what is missing: a and b."


def test_lists_within_a_sentence_name_what_they_are_about() -> None:
    error = SimpleNamespace(
        alignment="frames", alignment_arcsec=np.ones(3), stays=np.array([True, False, True])
    )
    assert "the rest in pitch and roll is a bias that stays" in told("alignment", error)
    error.stays[:] = False
    assert "stays" not in told("alignment", error)
    priors = SimpleNamespace(ok=False, names=("x0", "y0", "f"), diagnosis=(WEAK, CONFLICT, WEAK))
    said = f"The priors matter: {CONFLICT} for y0; {WEAK} for x0, f."
    assert told("prior_sensitivity", priors) == said


def test_no_list_asks_for_its_own_loop_before_it_runs() -> None:
    """Jinja knows `loop` within a loop, and not in the condition that chooses its items."""
    asking = re.compile(r"{%[^%]*\bfor\b[^%]* if [^%]*\bloop\b")
    assert [name for name, text in templates().items() if asking.search(text)] == []
    assert asking.search("{% for a in b if c[loop.index0] %}")


def test_compiled_templates_are_kept_and_damaged_ones_compiled_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compiled = []
    compile_it = jinja2.Environment.compile

    def counted(*given: Any, **options: Any) -> Any:
        compiled.append(given)
        return compile_it(*given, **options)

    monkeypatch.setattr(jinja2.Environment, "compile", counted)

    def filled() -> int:
        """Templates compiled in a fresh environment."""
        compiled.clear()
        loader = jinja2.DictLoader({"sum": "{{ a + b }}"})
        environment = jinja2.Environment(loader=loader, bytecode_cache=CompiledTemplates())
        assert environment.get_template("sum").render(a=1, b=2) == "3"
        return len(compiled)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert [filled(), filled()] == [1, 0]
    (kept,) = (path for path in tmp_path.rglob("*") if path.is_file())
    whole = kept.read_bytes()
    for damage in (b"", b"no template", whole[: len(whole) // 2], whole[: len(whole) - 1]):
        kept.write_bytes(damage)
        assert [filled(), filled()] == [1, 0]
    # A file is in the way of the folder.
    monkeypatch.setenv("XDG_CACHE_HOME", str(kept))
    assert [filled(), filled()] == [1, 1]
