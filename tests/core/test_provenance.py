"""The provenance of a result: facts with types for code, a dictionary for readers and files."""

import ast
import json
import pickle
from pathlib import Path

import starcal_uq
from starcal_uq.core.provenance import Provenance, data_hashes, provenance

PACKAGE = Path(starcal_uq.__file__).parent


def reads_by_key(tree):
    """Whether a syntax tree holds ``x.provenance["key"]`` or ``x.provenance.get("key")``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript):
            held, key = node.value, node.slice
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.args:
            held, key = node.func.value, node.args[0]
        else:
            continue
        if isinstance(key, ast.Constant) and getattr(held, "attr", None) == "provenance":
            return True
    return False


def test_code_reads_the_facts_of_a_provenance_and_no_keys():
    assert reads_by_key(ast.parse('cal.provenance["settings"]'))
    assert reads_by_key(ast.parse('cal.provenance.get("seed")'))
    assert not reads_by_key(ast.parse("cal.provenance.settings"))
    paths = [path for path in PACKAGE.rglob("*.py") if path.name != "provenance.py"]
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    assert not [p for p, text in texts.items() if ".prov" in text and reads_by_key(ast.parse(text))]


def test_entries_that_are_missing_have_a_value_and_the_rest_is_kept():
    empty = Provenance()
    assert (empty.created_utc, empty.seed, empty.settings, empty.version) == ("", None, {}, "")
    assert empty.likelihood == "marginal" and empty.inflation is None and not empty.dropped_frames
    made = provenance(3, {"method": "efficient"}, "ab").adding(kernels="numpy")
    assert made["kernels"] == "numpy" and made.seed == 3 and made.data_sha256 == "ab"
    changed = made.with_settings(likelihood="student_t")
    assert changed.likelihood == "student_t"
    assert made.settings == {"method": "efficient"}
    again = Provenance.from_dict(json.loads(json.dumps(changed)))
    assert again == changed == pickle.loads(pickle.dumps(changed))
    assert isinstance(pickle.loads(pickle.dumps(changed)), Provenance)


def test_hashes_are_those_of_the_data_of_partitions_and_of_merged_runs():
    parts = [{"data_sha256": ["a", "b"]}, {"data_sha256": ["c"]}]
    record = Provenance(data_sha256="d", merge={"parts": parts}, partitions={"data_sha256": ["e"]})
    assert data_hashes(record) == data_hashes(dict(record)) == set("abcde")
    assert data_hashes({}) == set()
