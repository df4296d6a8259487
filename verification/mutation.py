"""Do the tests notice when the mathematics is changed? Mutation testing by one command.

    python -m verification.mutation [--seed N] [--subject NAME ...] [--again] [--show] [--write]

A mutant is one small change of the source: a sign, a comparison, a constant, a transpose. A seed
draws one of each function of a subject; a later seed leaves out what those before it draw, so its
first result is of changes that no test was written against. Each is given to the fast tests that
reach its line, in a process of its own; it is killed when one of them fails. What was drawn and
tried is kept in `.bench/mutation`, so a run that is stopped resumes; without ``--seed`` nothing new
is tried. ``--again`` tries those that survived, after tests were strengthened. ``--show`` prints
survivors as differences, ``--write`` puts the table of all draws into
`docs/explanation/reliability.md`.

A subject's tests are collected once. Each mutant is a fork of that process in which the one
function gets its changed code; what stands outside functions is imported anew.

Not mutated, because no test should care: sentences, annotations, decorators, what follows
``raise``, sizes of blocks, seeds, and -1 where it stands for the last axis of two or for a size to
be found. `likelihood/loops` is left out: its compiled code is cached by the file on the disk. Tests
hold it equal to `likelihood/arrays`.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import gc
import hashlib
import inspect
import json
import math
import os
import re
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / ".bench" / "mutation"
PAGE = ROOT / "docs" / "explanation" / "reliability.md"

# Files of the package, and the tests that answer for them.
SUBJECTS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "likelihood": (("likelihood/*.py",), ("likelihood",)),
    "attitude": (("attitude/*.py",), ("attitude",)),
    "propagation": (("propagation/*.py",), ("propagation",)),
    "budget": (("budgeting/*.py",), ("budgeting",)),
    "inference": (("inference/*.py",), ("inference",)),
}
# A mutant may take this many times what its tests take, and this long beside, of the processor's
# time.
SLOWER, BESIDE_S = 5.0, 20.0
# Tests of a mutant take at most this long (s) without it: the quickest files that reach the line.
LONGEST_S = 60.0
# Exit status of a fork that came to no result.
BROKEN = 97

COMPARISONS = {
    ast.Lt: ">=",
    ast.LtE: ">",
    ast.Gt: "<=",
    ast.GtE: "<",
    ast.Eq: "!=",
    ast.NotEq: "==",
}
COMPARISONS |= {ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in"}
BORDERS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
ARITHMETIC = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.Pow: "*",
    ast.FloorDiv: "/",
    ast.Mod: "//",
}
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
    return (
        isinstance(node, ast.UnaryOp)
        and isinstance(node.op, ast.USub)
        and isinstance(node.operand, ast.Constant)
    )


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
        for argument, default in (
            *defaults,
            *zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True),
        ):
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
        return isinstance(target, ast.Name) and bool(
            re.search(r"_AT_ONCE|BLOCK|CHUNK|CACHE", target.id)
        )

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
            if type(operator) in BORDERS and any(
                counted.fullmatch(self.code(side)) for side in (left, right)
            ):
                self.swap(left, right, BORDERS[type(operator)], "border")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        sides = (node.left, node.right)
        sentence = any(
            isinstance(side, ast.JoinedStr | ast.List | ast.Tuple) or _text(side) for side in sides
        )
        if type(node.op) in ARITHMETIC and not sentence:
            self.swap(node.left, node.right, ARITHMETIC[type(node.op)], "arithmetic")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self.swap(
            node.values[0], node.values[1], "or" if isinstance(node.op, ast.And) else "and", "logic"
        )
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
        name = (
            node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        )
        if name in TWINS and not (name == "sum" and isinstance(node.func, ast.Name)):
            code = self.code(node.func)
            self.add(node.func, code[: len(code) - len(name)] + TWINS[name], "function")
        self.visit(node.func)
        for part in (*node.args, *(key.value for key in node.keywords if key.arg != "strict")):
            if not (
                _last(part)
                and (name == "reshape" or any(key.arg == "axis" for key in node.keywords))
            ):
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
    found = [
        path for name in SUBJECTS[subject][0] for path in sorted((ROOT / "starcal_uq").glob(name))
    ]
    return [path.relative_to(ROOT).as_posix() for path in found if path.name != "__init__.py"]


def drawn(found: dict[str, Mutant], seed: int, before: Iterable[str] = ()) -> list[str]:
    """Keys of the mutants that a seed draws, in the order of the source; without those `before` and
    of lower seeds.
    """
    chosen: dict[tuple[str, str], str] = {}
    gone = {*before}
    for turn in range(1, seed + 1):
        gone |= {*chosen.values()}
        chosen = {}
        for name in sorted(
            {*found} - gone, key=lambda name: hashlib.sha256(f"{turn} {name}".encode()).digest()
        ):
            chosen.setdefault((found[name].file, found[name].function), name)
    return sorted(chosen.values(), key=lambda name: (found[name].file, found[name].start))


class Reached:
    """Which lines of some files each test reaches, and what it costs; a plug-in for pytest."""

    def __init__(self, files: list[str]) -> None:
        self.files = {str(ROOT / file): file for file in files}
        self.tests: dict[str, dict[str, Any]] = {}
        self.lines = set[tuple[str, int]]()
        # What a fixture reaches counts for all tests that ask for it.
        self.fixtures: dict[Any, set[tuple[str, int]]] = {}

    def local(self, frame: FrameType, event: str, argument: Any) -> Any:
        self.lines.add((self.files[frame.f_code.co_filename], frame.f_lineno))
        return self.local

    def trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        return self.local if frame.f_code.co_filename in self.files else None

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Any:
        before, self.lines = self.lines, set()
        try:
            return (yield)
        finally:
            self.fixtures[fixturedef] = self.lines
            self.lines = self.lines | before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Any:
        self.lines, began = set(), time.process_time()
        sys.settrace(self.trace)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            asked = (
                found
                for several in item._fixtureinfo.name2fixturedefs.values()
                for found in several
            )
            lines = self.lines.union(*(self.fixtures.get(fixture, ()) for fixture in asked))
            self.tests[item.nodeid] = {
                "seconds": time.process_time() - began,
                "lines": sorted(lines),
            }


def quiet_pytest(arguments: list[str], log: Path, plugins: list[Any]) -> int:
    """Run pytest in this process, its output into a file."""
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    options = [
        "-q",
        "-x",
        "-m",
        "not slow",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "--tb=line",
        "-W",
        "ignore",
    ]
    return int(pytest.main([*options, *arguments], plugins))


def forked(work: Callable[[], int], seconds: float = 0.0) -> str:
    """What became of `work()` in a process of its own, of so much processor time: its status, or
    ``timeout``.
    """
    process = os.fork()
    if process == 0:
        status = BROKEN
        try:
            if seconds:
                os.setsid()
                resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 5))
                resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
            status = work()
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(status)
    # A process that waits for something that never comes uses no processor.
    end = time.monotonic() + (20.0 * seconds or math.inf)
    while time.monotonic() < end:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return (
                "timeout"
                if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU
                else str(status)
            )
        time.sleep(0.01)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return "timeout"


def digest(*paths: Path) -> str:
    """A key of what files hold."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(paths))).hexdigest()[:16]


def files_of_tests(subject: str) -> list[Path]:
    """Files of the tests that answer for a subject."""
    named = [ROOT / "tests" / name for name in SUBJECTS[subject][1]]
    return [
        path
        for test in named
        for path in (sorted(test.glob("test_*.py")) if test.is_dir() else [test])
    ]


def tests_for(mutant: Mutant, tests: dict[str, dict[str, Any]]) -> tuple[list[str], float]:
    """Tests to run, quickest first, file by file, and what they cost (s).

    What a file makes once is counted for its first test, so tests of a file that do not reach the
    line come after those that do. A line outside all functions is reached by all tests.
    """
    hits = {
        name for name, test in tests.items() if [mutant.file, mutant.line] in test["lines"]
    } or set(tests)
    order: list[str] = []
    cost = 0.0
    by_file: dict[str, list[str]] = {}
    for name in tests:
        by_file.setdefault(name.split("::")[0], []).append(name)
    reached = [names for names in by_file.values() if any(name in hits for name in names)]
    for names in sorted(
        reached, key=lambda names: min(tests[name]["seconds"] for name in names if name in hits)
    ):
        for name in sorted(names, key=lambda name: (name not in hits, tests[name]["seconds"])):
            if cost + tests[name]["seconds"] <= LONGEST_S or not order:
                order.append(name)
                cost += tests[name]["seconds"]
    return order, cost


def key(mutant: Mutant, text: str) -> str:
    """A mutant is known by the change and its surroundings, wherever these stand in the file."""
    around = (
        text[max(0, mutant.start - 60) : mutant.start] + "|" + text[mutant.start : mutant.end + 40]
    )
    return hashlib.sha256("\0".join((mutant.file, around, mutant.new)).encode()).hexdigest()[:16]


def difference(mutant: Mutant, text: str) -> str:
    """The change as a few lines of a unified difference."""
    lines = difflib.unified_diff(
        text.splitlines(), mutant.source(text).splitlines(), n=0, lineterm=""
    )
    return "\n".join([f"{mutant.file}:{mutant.line} ({mutant.what})", *list(lines)[3:]])


def codes(code: CodeType) -> dict[tuple[str, int], CodeType]:
    """Code of the functions of a module and of its classes, by their name and first line."""
    found: dict[tuple[str, int], CodeType] = {}
    for part in code.co_consts:
        if isinstance(part, CodeType):
            function = part.co_flags & inspect.CO_OPTIMIZED
            found |= {(part.co_qualname, part.co_firstlineno): part} if function else codes(part)
    return found


Functions = dict[tuple[str, str, int], list[FunctionType]]


def functions_of(files: Iterable[str]) -> Functions:
    """All functions that some files made, whoever holds them, by file, name and first line."""
    wanted = {str(ROOT / file) for file in files}
    found: Functions = {}
    gc.unfreeze()
    for thing in gc.get_objects():
        if type(thing) is FunctionType and thing.__code__.co_filename in wanted:
            code = thing.__code__
            found.setdefault((code.co_filename, code.co_qualname, code.co_firstlineno), []).append(
                thing
            )
    gc.freeze()
    return found


def changes(mutant: Mutant, text: str, live: Functions) -> list[Callable[[], None]]:
    """What makes the functions of this process those of the mutant; nothing if its change is in no
    function.
    """
    path, new_text = str(ROOT / mutant.file), mutant.source(text)
    old, new = (
        codes(compile(source, path, "exec", dont_inherit=True)) for source in (text, new_text)
    )
    found: list[Callable[[], None]] = []
    for place, code in new.items():
        if code != old.get(place):
            found += [
                partial(setattr, function, "__code__", code)
                for function in live.get((path, *place), [])
            ]
    for before, node in zip(ast.walk(ast.parse(text)), ast.walk(ast.parse(new_text)), strict=False):
        if isinstance(node, ast.FunctionDef) and isinstance(before, ast.FunctionDef):
            if ast.dump(before.args) == ast.dump(node.args):
                continue
            line = min([node.lineno, *(part.lineno for part in node.decorator_list)])
            for function in (
                f
                for (p, _, at), several in live.items()
                if (p, at) == (path, line)
                for f in several
            ):
                found += [partial(_set_defaults, function, node.args)]
    return found


def _set_defaults(function: FunctionType, arguments: ast.arguments) -> None:
    def value(node: ast.expr) -> Any:
        return eval(compile(ast.Expression(node), "", "eval"), function.__globals__)

    function.__defaults__ = tuple(map(value, arguments.defaults)) or None
    named = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    function.__kwdefaults__ = {
        key.arg: value(node) for key, node in named if node is not None
    } or None


class Trials:
    """Mutants of a subject, tried in forks of a process that has collected its tests; a plug-in for
    pytest.
    """

    def __init__(
        self, subject: str, todo: list[tuple[Mutant, str]], tell: Callable[[Mutant, str], None]
    ) -> None:
        self.subject, self.todo, self.tell = subject, todo, tell

    def pytest_runtestloop(self, session: Any) -> bool:
        items = {item.nodeid: item for item in session.items}
        tests = self.reach(session)
        live = functions_of({mutant.file for mutant, _ in self.todo})
        for mutant, text in self.todo:
            names, seconds = tests_for(mutant, tests)
            new = changes(mutant, text, live)

            def within(new: list[Callable[[], None]] = new, names: list[str] = names) -> int:
                for change in new:
                    change()
                return self.tests(session, [items[name] for name in names])

            def anew(mutant: Mutant = mutant, text: str = text, names: list[str] = names) -> int:
                for name in [
                    name
                    for name in sys.modules
                    if name.split(".")[0] in ("starcal_uq", "tests", "conftest")
                ]:
                    del sys.modules[name]
                changed, plain = str(ROOT / mutant.file), SourceFileLoader.get_code

                def get_code(loader: Any, name: str) -> CodeType | None:
                    if loader.path != changed:
                        return plain(loader, name)
                    return compile(mutant.source(text), changed, "exec", dont_inherit=True)

                SourceFileLoader.get_code = get_code
                return quiet_pytest(names, OUT / f"last-{os.getppid()}.log", [])

            status = forked(within if new else anew, SLOWER * seconds + BESIDE_S)
            if status == str(BROKEN << 8):
                raise RuntimeError(f"a mutant could not be tried: {difference(mutant, text)}")
            self.tell(mutant, {"0": "survived", "timeout": "timeout"}.get(status, "killed"))
        return True

    @staticmethod
    def tests(session: Any, items: list[Any]) -> int:
        for item, following in zip(items, [*items[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if session.testsfailed:
                return 1
        return 0

    def reach(self, session: Any) -> dict[str, dict[str, Any]]:
        """Tests with the lines they reach; measured once for each state of the sources and of a
        file of tests.
        """
        files = files_of(self.subject)
        sources = [ROOT / file for file in files]
        kept = {
            path: OUT / f"reach-{path.stem}-{digest(*sources, path)}.json"
            for path in files_of_tests(self.subject)
        }
        missing = [item for item in session.items if not kept[item.path].exists()]

        def work() -> int:
            plugin = Reached(files)
            session.config.pluginmanager.register(plugin)
            status = self.tests(session, missing)
            for path in {item.path for item in missing if not status}:
                names = [item.nodeid for item in missing if item.path == path]
                kept[path].write_text(
                    json.dumps({name: plugin.tests[name] for name in names}), "utf-8"
                )
            return status

        if missing and forked(work) != "0":
            raise RuntimeError("the tests fail without any change")
        found: dict[str, dict[str, Any]] = {}
        for path in {item.path: None for item in session.items}:
            found |= json.loads(kept[path].read_text("utf-8"))
        return found


def entries() -> list[dict[str, Any]]:
    """What was tried, in the order of time."""
    log = OUT / "tried.jsonl"
    return (
        [json.loads(line) for line in log.read_text("utf-8").splitlines()] if log.exists() else []
    )


def draw(subject: str, seed: int) -> None:
    """Keep what a seed draws of a subject, as the source is now."""
    kept = OUT / f"draw-{seed}-{subject}.json"
    if not kept.exists():
        found = known(subject)[0]
        before = [
            name
            for path in OUT.glob(f"draw-*-{subject}.json")
            for name in json.loads(path.read_text())["keys"]
        ]
        commit = subprocess.run(
            ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False
        ).stdout
        made = {"commit": commit.strip(), "mutants": len(found)}
        keys = drawn(found, seed, before)
        kept.write_text(
            json.dumps({"subject": subject, "seed": seed, **made, "keys": keys}), "utf-8"
        )


def known(subject: str) -> tuple[dict[str, Mutant], dict[str, str]]:
    """All mutants of a subject by their key, and the text of its files."""
    texts = {file: (ROOT / file).read_text("utf-8") for file in files_of(subject)}
    return {
        key(mutant, texts[mutant.file]): mutant for file in texts for mutant in mutants(file)
    }, texts


def draws(subjects: Iterable[str]) -> list[dict[str, Any]]:
    """Kept draws of some subjects: with the first outcome of each key, and the last."""
    tried, found = entries(), []
    for subject in subjects:
        now, texts = known(subject)
        for path in sorted(OUT.glob(f"draw-*-{subject}.json")):
            one = json.loads(path.read_text("utf-8"))
            of_these = {
                name: [e["outcome"] for e in tried if e["key"] == name] for name in one["keys"]
            }
            first = {name: outcomes[0] for name, outcomes in of_these.items() if outcomes}
            last = {name: of_these[name][-1] for name in first}
            last |= {
                name: "gone"
                for name, what in last.items()
                if what == "survived" and name not in now
            }
            found.append({**one, "first": first, "last": last, "now": now, "texts": texts})
    return found


def run(one: dict[str, Any], again: bool) -> None:
    """Try the mutants of a draw that were not tried yet, or those that survived."""
    title, names = f"{one['subject']} {one['seed']}", one["last"]
    chosen = [
        name
        for name in one["keys"]
        if (names.get(name) == "survived" if again else name not in names)
    ]
    todo = {one["now"][name]: name for name in chosen if name in one["now"]}
    if not todo:
        return
    screen = os.fdopen(os.dup(1), "w")
    count = iter(range(1, len(todo) + 1))

    def tell(mutant: Mutant, outcome: str) -> None:
        with (OUT / "tried.jsonl").open("a", encoding="utf-8") as stream:
            stream.write(
                json.dumps({"key": todo[mutant], "outcome": outcome, **asdict(mutant)}) + "\n"
            )
        place = f"{mutant.file}:{mutant.line} {mutant.what}"
        print(f"{title} {next(count)}/{len(todo)} {place}: {outcome}", file=screen, flush=True)

    log = OUT / f"{title.replace(' ', '-')}.log"
    trials = Trials(one["subject"], [(mutant, one["texts"][mutant.file]) for mutant in todo], tell)
    if (
        forked(
            lambda: quiet_pytest(
                [str(path) for path in files_of_tests(one["subject"])], log, [trials]
            )
        )
        != "0"
    ):
        raise SystemExit(f"the tests of {title} cannot be run: {log}")


def table(found: list[dict[str, Any]]) -> str:
    """The table of the documentation: the last draw of each subject."""
    from starcal_uq.maths.intervals import binomial_interval

    lines = [
        "| Subject | Mutants | Seed | Tried | Killed at first | Share (95 %) | Killed now | Gone | "
        "Left |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    # A few that were tried say nothing yet.
    enough = [one for one in found if len(one["first"]) >= 0.4 * len(one["keys"])]
    enough.sort(key=lambda one: one["seed"])
    for one in {one["subject"]: one for one in enough}.values():
        first, last = [*one["first"].values()], Counter(one["last"].values())
        n, survived = len(first), first.count("survived")
        low, high = binomial_interval(n - survived, n)
        tried = f"{n}" if n == len(one["keys"]) else f"{n} of {len(one['keys'])}"
        share = f"{100 * (n - survived) / n:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
        killed, gone, left = last["killed"] + last["timeout"], last["gone"], last["survived"]
        row = (one["subject"], one["mutants"], one["seed"], tried, n - survived, share)
        lines.append(f"| {' | '.join(map(str, (*row, killed, gone, left)))} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Mutation testing of the mathematics.")
    parser.add_argument(
        "--seed", type=int, help="try what this seed draws, as far as it was not tried"
    )
    parser.add_argument("--subject", nargs="+", choices=[*SUBJECTS], default=[*SUBJECTS])
    parser.add_argument(
        "--again", action="store_true", help="try again those that survived, of all draws"
    )
    parser.add_argument("--show", action="store_true", help="print what survived")
    parser.add_argument(
        "--write", action="store_true", help="put the table of last draws into the documentation"
    )
    options = parser.parse_args(arguments)
    OUT.mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    sys.dont_write_bytecode = False
    sys.path[:0] = [str(ROOT)]
    os.environ.update(
        dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
        MPLBACKEND="Agg",
    )
    if options.seed is not None:
        for subject in options.subject:
            draw(subject, options.seed)
    for one in draws(options.subject):
        if options.again or one["seed"] == options.seed:
            run(one, options.again)
    if options.show:
        for one in draws(options.subject):
            for name, mutant in one["now"].items():
                if one["last"].get(name) == "survived":
                    print(
                        f"seed {one['seed']} {difference(mutant, one['texts'][mutant.file])}",
                        end="\n\n",
                    )
    made = table([one for one in draws(SUBJECTS) if one["first"]])
    print(made)
    if options.write:
        from benchmarks.pages import put

        put(PAGE, "mutation", made)


if __name__ == "__main__":
    main()
