"""Loops over stars compiled by Numba, where it is installed, and kept on disk.

The extra ``compiled`` installs it. Which path runs is decided by one switch, the
environment variable ``STARCAL_UQ_KERNELS`` (`use` sets it): ``numpy``, ``numba``, or ``auto`` (the
default), which compiles nothing for a job that would be done before the compiler is. Both give the
same to rounding; provenance says which one ran.

The source is generated from CasADi's instructions, like that of the NumPy kernels, and stands in a
folder of the user named by its content and the versions that compile it, because Numba keeps
machine code beside a file. Where that folder cannot be written, everything is compiled in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from starcal_uq.core.errors import StarcalError
from starcal_uq.core.extras import extra
from starcal_uq.core.files import atomic_path
from starcal_uq.core.provenance import NAME, installed_version

SWITCH = "STARCAL_UQ_KERNELS"
CHOICES = ("auto", "numpy", "numba")
# Stars from which loading compiled loops (0.6 s) is worth it, and from which compiling them (half a
# minute) is.
WORTH_LOADING, WORTH_COMPILING = 200_000, 10_000_000
_loaded: dict[str, ModuleType] = {}


def use(choice: str) -> None:
    """Choose ``numpy``, ``numba`` or ``auto`` for this process and those that it starts."""
    _check(choice)
    os.environ[SWITCH] = choice


@contextlib.contextmanager
def using(choice: str) -> Iterator[None]:
    """As `use`, for a while."""
    before = os.environ.get(SWITCH)
    use(choice)
    try:
        yield
    finally:
        if before is None:
            del os.environ[SWITCH]
        else:
            os.environ[SWITCH] = before


def _check(choice: str) -> None:
    if choice not in CHOICES:
        raise StarcalError(
            f"kernels {choice!r} are unknown: set {SWITCH} to one of {', '.join(CHOICES)}."
        )
    if choice == "numba" and not installed():
        with extra("compiled", "compiled kernels", f"set {SWITCH}=numpy"):
            raise ModuleNotFoundError(name="numba")


def installed() -> bool:
    """Whether Numba is there; it is not imported for that."""
    return importlib.util.find_spec("numba") is not None


def chosen(n_stars: int, source: Callable[[], str]) -> str:
    """``numpy`` or ``numba`` for a job of so many stars, with loops of the source that a function
    gives.
    """
    choice = os.environ.get(SWITCH, "auto").strip().lower() or "auto"
    _check(choice)
    if choice != "auto":
        return choice
    if n_stars < WORTH_LOADING or not installed():
        return "numpy"
    ready = n_stars >= WORTH_COMPILING or (_folder(source()) / "ready").exists()
    return "numba" if ready else "numpy"


def cache_folder() -> Path:
    """Folder of the user for what can be made again."""
    if os.name == "nt":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / NAME


def _folder(source: str) -> Path:
    versions = [installed_version(name) for name in ("numba", "llvmlite", "numpy")]
    key = "\n".join([source, *map(str, versions), sys.version, platform.platform()])
    return cache_folder() / "kernels" / hashlib.sha256(key.encode()).hexdigest()[:24]


def load(name: str, source: str) -> Any:
    """Import a generated module, its functions compiled; the machine code of earlier processes is
    used.
    """
    found = _loaded.get(source)
    if found is None:
        found = _loaded[source] = _import(name, source)
    return found


def _import(name: str, source: str) -> ModuleType:
    path = _folder(source) / f"{name}.py"
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not path.exists() or path.read_text(encoding="utf-8") != source:
            with atomic_path(path) as temporary:
                temporary.write_text(source, encoding="utf-8")
        # A folder that another user may write to would let him run what he likes.
        writable = os.access(path.parent, os.W_OK) and (
            os.name == "nt" or path.stat().st_uid == os.getuid()
        )
    except (OSError, RuntimeError, StarcalError):
        writable = False
    if writable:
        # Numba finds the globals of what it kept by the name of their module.
        title = f"starcal_uq_{name}_{path.parent.name}"
        spec = importlib.util.spec_from_file_location(title, path)
        assert spec is not None and spec.loader is not None
        module = sys.modules[title] = importlib.util.module_from_spec(spec)
        # Whatever is wrong with what was kept, it can be made again.
        with contextlib.suppress(Exception):
            # Signatures are written in the source: all of it is compiled here, or read from beside
            # it.
            spec.loader.exec_module(module)
            path.with_name("ready").touch()
            return module
        del sys.modules[title]
    module = ModuleType(f"starcal_uq_compiled_{name}")
    # Generated above from CasADi's instructions and this package's own loops; nothing comes from
    # outside.
    exec(
        compile(source.replace("cache=True", "cache=False"), f"<compiled {name}>", "exec"),
        module.__dict__,
    )
    return module
