"""Do the tests notice when the mathematics is changed? Mutation testing by one command.

    python benchmarks/mutation.py [--subject NAME ...] [--number N] [--seed 1] [--again] [--show] [--write]

A mutant is one small change of the source: a sign, a comparison, a constant, a transpose. Of all mutants of a subject
some are drawn by the seed: one of each function, and beyond that a second of each; a larger number holds a smaller
one. Each is given to the tests that reach its line, in a
process of its own; it is killed when one of them fails. What was tried is kept in `.bench/mutation`;
``--again`` tries those that survived, after tests were strengthened. ``--show`` prints survivors as differences,
``--write`` puts the table into the documentation (`docs/explanation/reliability.md`).

Only the tests that reach a line are run for it, in a process that is forked after the heavy libraries are loaded.

Not mutated, because no test should care: sentences, annotations, decorators, what follows ``raise``, sizes of blocks,
seeds, and -1 where it stands for the last axis of two or for a size to be found. `estimation/loops` is left out: its
compiled code is cached by the file on the disk. Tests hold it equal to `estimation/sums`.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import importlib
import importlib.abc
import importlib.machinery
import json
import os
import re
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / ".bench" / "mutation"
PAGE = ROOT / "docs" / "explanation" / "reliability.md"

# Files of the package, and the tests that answer for them.
SUBJECTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "likelihood": (
        ("estimation/marginal.py", "estimation/sums.py", "estimation/compressed.py", "estimation/student.py"),
        tuple(f"estimation/test_{name}.py" for name in ("likelihood", "sums", "student", "merging")),
    ),
    "pairs": (
        ("estimation/pairs.py", "estimation/composite.py"),
        ("estimation/test_pairs.py", "estimation/test_pair_likelihood.py"),
    ),
    "attitude": (("attitude/*.py",), ("attitude",)),
    "propagation": (("propagation/*.py",), ("propagation",)),
    "budget": (("budgeting/*.py",), ("budgeting",)),
    "inference": (("inference/*.py",), ("inference",)),
}
HEAVY = (
    *("numpy", "scipy.linalg", "scipy.optimize", "scipy.stats", "scipy.special", "scipy.spatial", "scipy.interpolate"),
    *("casadi", "emcee", "arviz", "pandas", "pyarrow.parquet", "astropy.table", "pydantic", "hypothesis", "openpyxl"),
    *("jinja2", "matplotlib.pyplot", "xarray", "dask", "rich", "typer"),
)
# A mutant may take this many times what its tests take, and this long beside, of the processor's time.
SLOWER, BESIDE_S = 5.0, 20.0
# Tests of a mutant take at most this long (s) without it: the quickest files that reach the line.
LONGEST_S = 60.0
FIRST = 5

COMPARISONS = {ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "=="}
COMPARISONS |= {ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in"}
BORDERS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
ARITHMETIC = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Pow: "*", ast.FloorDiv: "/", ast.Mod: "//"}
ARITHMETIC |= {ast.BitAnd: "|", ast.BitOr: "&"}
TWINS = {
    "min": "max",
    "any": "all",
    "argmin": "argmax",
    "sin": "cos",
    "minimum": "maximum",
    "sum": "mean",
    "floor": "ceil",
}
TWINS |= {other: one for one, other in TWINS.items() if one != "sum"}


@dataclass(frozen=True)
class Mutant:
    """One change: the text from `start` to `end` (offsets in the file) becomes `new`."""

    file: str
    line: int
    start: int
    end: int
    new: str
    what: str
    function: str

    def source(self, text: str) -> str:
        """The changed file."""
        return text[: self.start] + self.new + text[self.end :]


def _text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _last(node: ast.expr) -> bool:
    return isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant)


class Places(ast.NodeVisitor):
    """All mutants of a file."""

    def __init__(self, file: str, text: str) -> None:
        self.file, self.text, self.found = file, text, list[Mutant]()
        self.around: list[str] = []
        # `ast` counts columns in bytes.
        self.lines = [line.encode() for line in text.splitlines(keepends=True)]
        self.offsets = [0]
        for line in text.splitlines(keepends=True):
            self.offsets.append(self.offsets[-1] + len(line))

    def at(self, line: int, column: int) -> int:
        return self.offsets[line - 1] + len(self.lines[line - 1][:column].decode())

    def span(self, node: Any) -> tuple[int, int]:
        return self.at(node.lineno, node.col_offset), self.at(node.end_lineno, node.end_col_offset)

    def code(self, node: Any) -> str:
        start, end = self.span(node)
        return self.text[start:end]

    def add(self, node: Any, new: str, what: str) -> None:
        start, end = self.span(node)
        # The line breaks of the text that goes stay, so that later lines keep their numbers.
        gone = self.text[start:end].count("\n") - new.count("\n")
        self.put(node.lineno, start, end, f"({new}{chr(10) * gone})" if gone else new, what)

    def put(self, line: int, start: int, end: int, new: str, what: str) -> None:
        self.found.append(Mutant(self.file, line, start, end, new, what, ".".join(self.around)))

    def swap(self, left: Any, right: Any, new: str, what: str) -> None:
        """Another operator between two operands."""
        start, end = self.span(left)[1], self.span(right)[0]
        between = self.text[start:end]
        sign = re.sub(r"#.*", lambda found: " " * len(found[0]), between).strip(" ()\n")
        place = start + between.index(sign)
        self.put(left.end_lineno, place, place + len(sign), new, what)

    # --- what is left alone
    def visit_Raise(self, node: ast.Raise) -> None: ...
    def visit_JoinedStr(self, node: ast.JoinedStr) -> None: ...
    def visit_Import(self, node: ast.Import) -> None: ...
    def visit_ImportFrom(self, node: ast.ImportFrom) -> None: ...

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        named = [*node.args.posonlyargs, *node.args.args][::-1]
        defaults = [*zip(named, node.args.defaults[::-1], strict=False)]
        for argument, default in (*defaults, *zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)):
            if default is not None and argument.arg != "seed":
                self.visit(default)
        self.within(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self.within(node)

    def within(self, node: ast.FunctionDef | ast.ClassDef) -> None:
        self.around.append(node.name)
        self.body(node.body)
        self.around.pop()

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None and not self.a_size(node.target):
            self.visit(node.value)

    def visit_If(self, node: ast.If) -> None:
        if "TYPE_CHECKING" in self.code(node.test):
            return
        if not isinstance(node.test, ast.Compare | ast.UnaryOp):
            self.add(node.test, f"not ({self.code(node.test)})", "condition negated")
        self.visit(node.test)
        self.body([*node.body, *node.orelse])

    def body(self, nodes: list[Any]) -> None:
        for node in nodes:
            self.visit(node)

    @staticmethod
    def a_size(target: ast.expr) -> bool:
        """A tuning of speed and memory, which no result depends on."""
        return isinstance(target, ast.Name) and bool(re.search(r"_AT_ONCE|BLOCK|CHUNK|CACHE", target.id))

    # --- what is changed
    def visit_Assign(self, node: ast.Assign) -> None:
        names = [target.id for target in node.targets if isinstance(target, ast.Name)]
        if any(name == "__all__" for name in names) or self.a_size(node.targets[0]):
            return
        if any(isinstance(target, (ast.Attribute, ast.Subscript)) for target in node.targets):
            self.add(node, "...", "statement dropped")
        for target in node.targets:
            self.visit(target)
        self.visit(node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.add(node, "...", "statement dropped")
        if type(node.op) in ARITHMETIC:
            self.swap(node.target, node.value, f"{ARITHMETIC[type(node.op)]}=", "arithmetic")
        self.visit(node.value)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        if isinstance(node.value, ast.Call):
            self.add(node, "...", "statement dropped")
        self.generic_visit(node)

    def visit_Break(self, node: ast.Break) -> None:
        self.add(node, "...", "statement dropped")

    def visit_Continue(self, node: ast.Continue) -> None:
        self.add(node, "...", "statement dropped")

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None and not isinstance(node.value, ast.Constant | ast.JoinedStr):
            self.add(node.value, "None", "nothing returned")
            self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        operands = [node.left, *node.comparators]
        for left, operator, right in zip(operands, node.ops, operands[1:], strict=False):
            self.swap(left, right, COMPARISONS[type(operator)], "comparison")
            # Between numbers that are not counted, equality does not happen.
            counted = re.compile(r"[1-9]\d*|len\(.*|n_\w+|.*\.(size|n_\w+)")
            if type(operator) in BORDERS and any(counted.fullmatch(self.code(side)) for side in (left, right)):
                self.swap(left, right, BORDERS[type(operator)], "border")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        sides = (node.left, node.right)
        sentence = any(isinstance(side, ast.JoinedStr | ast.List | ast.Tuple) or _text(side) for side in sides)
        if type(node.op) in ARITHMETIC and not sentence:
            self.swap(node.left, node.right, ARITHMETIC[type(node.op)], "arithmetic")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self.swap(node.values[0], node.values[1], "or" if isinstance(node.op, ast.And) else "and", "logic")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, (ast.USub, ast.Not)):
            self.add(node, f"({self.code(node.operand)})", "sign")
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        new = f"{self.code(node.orelse)} if {self.code(node.test)} else {self.code(node.body)}"
        self.add(node, new, "condition negated")
        self.generic_visit(node)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if node.attr == "T":
            self.add(node, self.code(node.value), "transpose dropped")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in TWINS and not (name == "sum" and isinstance(node.func, ast.Name)):
            code = self.code(node.func)
            self.add(node.func, code[: len(code) - len(name)] + TWINS[name], "function")
        self.visit(node.func)
        for part in (*node.args, *(key.value for key in node.keywords if key.arg != "strict")):
            if not (_last(part) and (name == "reshape" or any(key.arg == "axis" for key in node.keywords))):
                self.visit(part)

    def visit_Slice(self, node: ast.Slice) -> None:
        if node.upper is not None and not isinstance(node.upper, (ast.Constant, ast.UnaryOp)):
            self.add(node.upper, f"({self.code(node.upper)}) - 1", "slice")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.add(node, str(not value), "constant")
        elif isinstance(value, int):
            self.add(node, str(value + 1), "constant")
        elif isinstance(value, float):
            self.add(node, repr(value * 2.0) if value else "1.0", "constant")


def mutants(file: str) -> list[Mutant]:
    """All mutants of a file that compile, in the order of the source."""
    text = (ROOT / file).read_text("utf-8")
    places = Places(file, text)
    places.visit(ast.parse(text))
    return sorted(places.found, key=lambda m: (m.start, m.end, m.new))


def files_of(subject: str) -> list[str]:
    """Files of a subject, as paths from the root."""
    found = [path for name in SUBJECTS[subject][0] for path in sorted((ROOT / "starcal_uq").glob(name))]
    return [path.relative_to(ROOT).as_posix() for path in found if path.name != "__init__.py"]


def functions(found: Iterable[Mutant]) -> int:
    """In how many functions (a class and a file count as one for what is outside its own) some mutants are."""
    return len({(mutant.file, mutant.function) for mutant in found})


def sampled(subject: str, number: int | None, seed: int) -> tuple[list[Mutant], dict[str, str], list[Mutant]]:
    """Some mutants of a subject in the order of the source, the text of each file, and all mutants."""
    texts = {file: (ROOT / file).read_text("utf-8") for file in files_of(subject)}
    everything = [mutant for file in texts for mutant in mutants(file)]
    drawn = sorted(everything, key=lambda m: hashlib.sha256(f"{seed} {key(m, texts[m.file])}".encode()).digest())
    turns = Counter[tuple[str, str]]()
    ranks = []
    for mutant in drawn:
        ranks.append(turns[mutant.file, mutant.function])
        turns[mutant.file, mutant.function] += 1
    drawn = [mutant for _, mutant in sorted(zip(ranks, drawn, strict=True), key=lambda pair: pair[0])]
    return sorted(drawn[: number or len(turns)], key=lambda m: (m.file, m.start)), texts, everything


class Changed(importlib.abc.MetaPathFinder, importlib.machinery.SourceFileLoader):
    """Gives one file of the package another text."""

    def __init__(self, file: str, text: str) -> None:
        module = file.removesuffix(".py").replace("/", ".")
        super().__init__(module, str(ROOT / file))
        self.text = text

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        if fullname != self.name:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, origin=self.path)

    def get_code(self, fullname: str) -> CodeType:
        code: CodeType = compile(self.text, self.path, "exec", dont_inherit=True)
        return code


class Reached:
    """Which lines of some files each test reaches, and what it costs; a plug-in for pytest."""

    def __init__(self, files: list[str]) -> None:
        self.files = {str(ROOT / file): file for file in files}
        self.tests: dict[str, dict[str, Any]] = {}
        self.lines: set[tuple[str, int]] = set()

    def local(self, frame: FrameType, event: str, argument: Any) -> Any:
        self.lines.add((self.files[frame.f_code.co_filename], frame.f_lineno))
        return self.local

    def trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        return self.local if frame.f_code.co_filename in self.files else None

    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> None:
        self.lines, self.began = set(), time.process_time()
        sys.settrace(self.trace)

    def pytest_runtest_logfinish(self, nodeid: str, location: Any) -> None:
        sys.settrace(None)
        self.tests[nodeid] = {"seconds": time.process_time() - self.began, "lines": sorted(self.lines)}


def quiet_pytest(arguments: list[str], log: Path, plugins: list[Any]) -> int:
    """Run pytest in this process, its output into a file."""
    import pytest

    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    options = ["-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=line", "-W", "ignore"]
    return int(pytest.main([*options, *arguments], plugins))


def forked(work: Any, seconds: float) -> str:
    """What became of `work()` in a process of its own: its exit status, or ``timeout``."""
    process = os.fork()
    if process == 0:
        status = 97
        try:
            os.setsid()
            resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 5))
            resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
            status = work()
        finally:
            os._exit(status)
    # A process that waits for something that never comes uses no processor.
    end = time.monotonic() + 20.0 * seconds
    while time.monotonic() < end:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return "timeout" if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU else str(status)
        time.sleep(0.02)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return "timeout"


def digest(*paths: Path) -> str:
    """A key of what files hold."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(paths))).hexdigest()[:16]


def reach(subject: str) -> dict[str, dict[str, Any]]:
    """Tests of a subject with the lines they reach; measured once for each state of the files."""
    files, tests = files_of(subject), [ROOT / "tests" / name for name in SUBJECTS[subject][1]]
    sources = [path for test in tests for path in (sorted(test.glob("test_*.py")) if test.is_dir() else [test])]
    kept = OUT / f"reach-{subject}-{digest(*(ROOT / file for file in files), *sources)}.json"
    if not kept.exists():
        print(f"{subject}: measuring which tests reach which lines", flush=True)

        def work() -> int:
            plugin = Reached(files)
            status = quiet_pytest([str(test) for test in tests], OUT / f"reach-{subject}.log", [plugin])
            if status == 0:
                kept.write_text(json.dumps(plugin.tests), "utf-8")
            return status

        forked(work, 3000.0)
        if not kept.exists():
            raise SystemExit(f"the tests of {subject} fail without any change: {OUT / f'reach-{subject}.log'}")
    found: dict[str, dict[str, Any]] = json.loads(kept.read_text("utf-8"))
    return found


def tests_for(mutant: Mutant, tests: dict[str, dict[str, Any]]) -> tuple[list[str], float]:
    """Tests to run, quickest first, file by file, and what they cost (s).

    What a file makes once is counted for its first test, so tests of a file that do not reach the line come after
    those that do. A line outside all functions is reached by all tests.
    """
    hits = {name for name, test in tests.items() if [mutant.file, mutant.line] in test["lines"]} or set(tests)
    order: list[str] = []
    cost = 0.0
    by_file: dict[str, list[str]] = {}
    for name in tests:
        by_file.setdefault(name.split("::")[0], []).append(name)
    reached = [names for names in by_file.values() if any(name in hits for name in names)]
    for names in sorted(reached, key=lambda names: min(tests[name]["seconds"] for name in names if name in hits)):
        for name in sorted(names, key=lambda name: (name not in hits, tests[name]["seconds"])):
            if cost + tests[name]["seconds"] <= LONGEST_S or not order:
                order.append(name)
                cost += tests[name]["seconds"]
    return order, cost


def key(mutant: Mutant, text: str) -> str:
    """A mutant is known by the change and its surroundings, wherever these stand in the file."""
    around = text[max(0, mutant.start - 60) : mutant.start] + "|" + text[mutant.start : mutant.end + 40]
    return hashlib.sha256("\0".join((mutant.file, around, mutant.new)).encode()).hexdigest()[:16]


def difference(mutant: Mutant, text: str) -> str:
    """The change as a few lines of a unified difference."""
    lines = difflib.unified_diff(text.splitlines(), mutant.source(text).splitlines(), n=0, lineterm="")
    return "\n".join([f"{mutant.file}:{mutant.line} ({mutant.what})", *list(lines)[3:]])


def try_one(mutant: Mutant, text: str, tests: dict[str, dict[str, Any]]) -> str:
    """``killed``, ``timeout`` or ``survived``."""
    names, _ = tests_for(mutant, tests)
    # Most fall to the first few, and then the other files of tests need not be imported.
    for part in (names[:FIRST], names[FIRST:]):

        def work(part: list[str] = part) -> int:
            sys.meta_path.insert(0, Changed(mutant.file, mutant.source(text)))
            return quiet_pytest(part, OUT / "last.log", [])

        status = forked(work, SLOWER * sum(tests[name]["seconds"] for name in part) + BESIDE_S) if part else "0"
        if status != "0":
            return "timeout" if status == "timeout" else "killed"
    return "survived"


def run(subject: str, number: int | None, seed: int, again: bool) -> dict[str, Any]:
    """Try the mutants of a subject that were not tried yet."""
    chosen, texts, everything = sampled(subject, number, seed)
    log = OUT / "tried.jsonl"
    known = dict(_known(log))
    tests = None
    outcomes: list[tuple[Mutant, str, str]] = []
    for i, mutant in enumerate(chosen):
        text = texts[mutant.file]
        name = key(mutant, text)
        if name not in known or (again and known[name] == "survived"):
            tests = reach(subject) if tests is None else tests
            known[name] = try_one(mutant, text, tests)
            with log.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"key": name, "outcome": known[name], **asdict(mutant)}) + "\n")
            print(
                f"{subject} {i + 1}/{len(chosen)} {mutant.file}:{mutant.line} {mutant.what}: {known[name]}", flush=True
            )
        outcomes.append((mutant, known[name], text))
    return {"subject": subject, "all": everything, "outcomes": outcomes}


def _known(log: Path) -> Iterator[tuple[str, str]]:
    if log.exists():
        for line in log.read_text("utf-8").splitlines():
            entry = json.loads(line)
            yield entry["key"], entry["outcome"]


def table(results: list[dict[str, Any]]) -> str:
    """The table of the documentation."""
    from starcal_uq.maths.intervals import binomial_interval

    lines = [
        "| Subject | Mutants | In functions | Tried | In functions | Killed | Of these by time | Survived | "
        "Share killed (95 %) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for result in results:
        outcomes = [outcome for _, outcome, _ in result["outcomes"]]
        n, survived, late = len(outcomes), outcomes.count("survived"), outcomes.count("timeout")
        low, high = binomial_interval(n - survived, n)
        share = f"{100 * (n - survived) / n:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
        reached = functions(mutant for mutant, _, _ in result["outcomes"])
        lines.append(
            f"| {result['subject']} | {len(result['all'])} | {functions(result['all'])} | {n} | {reached} | "
            f"{n - survived} | {late} | {survived} | {share} |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Mutation testing of the mathematics.")
    parser.add_argument("--subject", nargs="+", choices=[*SUBJECTS], default=[*SUBJECTS])
    parser.add_argument("--number", type=int, help="mutants of each subject (one of each function)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="try again those that survived")
    parser.add_argument("--show", action="store_true", help="print what survived")
    parser.add_argument("--write", action="store_true", help="put the table into the documentation")
    options = parser.parse_args(arguments)
    OUT.mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    sys.dont_write_bytecode = False
    sys.path[:0] = [str(ROOT)]
    os.environ.update(
        dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"), MPLBACKEND="Agg"
    )
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for module in HEAVY:
            importlib.import_module(module)
    results = [run(subject, options.number, options.seed, options.again) for subject in options.subject]
    if options.show:
        for result in results:
            for mutant, outcome, text in result["outcomes"]:
                if outcome == "survived":
                    print(difference(mutant, text), end="\n\n")
    made = table(results)
    print(made)
    if options.write:
        from benchmarks.pages import put

        put(PAGE, "mutation", made)


if __name__ == "__main__":
    main()
