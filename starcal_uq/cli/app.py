"""The command line's entry, which catches what comes out of the commands.

Exit status 0 when all is well, 1 when a result is there but should not be trusted, 2 for bad input,
70 for a fault of the program, and 130 or 143 when Ctrl-C or SIGTERM has ended the work; but for 0,
always with one sentence that says what to do. Nothing that takes time is loaded before the signals
are caught.
"""

from __future__ import annotations

import gc
import inspect
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any, NoReturn

from starcal_uq.cli import HELP, VERSION_LINE

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# An internal software error, as `sysexits.h` numbers it.
FAULT = 70
_GETDOC = inspect.getdoc


def program() -> NoReturn:
    """The program: `main`, after which no signal is of interest any more."""
    sys.unraisablehook = _again
    words = sys.argv[1:]
    # Typer takes longer to load than these to answer.
    if words == ["--version"]:
        print(VERSION_LINE)
        sys.exit(0)
    if words == ["--help"] or not (words or "_STARCAL_UQ_COMPLETE" in os.environ):
        print(HELP.read_text("utf-8"), end="")
        sys.exit(0 if words else 2)
    try:
        main()
    finally:
        _catch(signal.SIG_IGN)
    sys.exit(0)


def main() -> None:
    """Run a command: every error a user can make is one sentence on standard error, never a
    traceback.
    """
    before = _catch(_end_at_once)
    inspect.getdoc = _docstring
    try:
        _main()
    finally:
        inspect.getdoc = _GETDOC
        for number, handler in before.items():
            signal.signal(number, handler)


def _docstring(object: object) -> str | None:
    """None for SciPy and matplotlib: they parse and extend thousands of their docstrings each time
    they are loaded, which takes a third and a fifth of the time of loading and which no command
    shows. Both also run without any (``python -OO``).
    """
    module = str(getattr(object, "__module__", ""))
    return None if module.startswith(("scipy.", "matplotlib.")) else _GETDOC(object)


def _main() -> None:
    from typer import Abort, Exit
    from typer.exceptions import TyperException

    from starcal_uq.cli.answers import begin
    from starcal_uq.cli.commands import app, usage_sentence
    from starcal_uq.cli.remedies import as_given
    from starcal_uq.cli.runfiles import expand
    from starcal_uq.core.errors import StarcalError
    from starcal_uq.core.remedy import spoken
    from starcal_uq.core.tasks import caught_signal, interrupt

    begin()
    caught_signal()
    _catch(interrupt)
    # Imports and figures make a million objects that live as long as the command; to look through
    # them every 700 new ones for what could be thrown away takes a twentieth of the time.
    gc.set_threshold(50_000, 20, 50)
    try:
        sys.argv[1:] = expand(sys.argv[1:], app.commands)
        with spoken(as_given):
            code = app(standalone_mode=False)
        if code == 128 + signal.SIGINT:
            # What Typer makes of it.
            raise KeyboardInterrupt
        sys.exit(code if isinstance(code, int) else 0)
    except (Exception, KeyboardInterrupt) as error:
        # Libraries make other errors of a KeyboardInterrupt that they meet.
        number = caught_signal()
        if number is not None or isinstance(error, Abort | KeyboardInterrupt):
            words = "interrupted; what was complete is kept: give the same command again to resume."
            _fail(words, 128 + (number or signal.SIGINT))
        if isinstance(error, Exit):
            sys.exit(error.exit_code)
        if isinstance(error, TyperException):
            _fail(usage_sentence(error), 2)
        if isinstance(error, StarcalError):
            _fail(str(error), 2)
        if isinstance(error, MemoryError):
            _fail("there is not enough memory for this: ask for fewer draws, frames or samples.", 2)
        if isinstance(error, OSError):
            place = f"{error.filename}: " if error.filename else ""
            _fail(
                (
                    f"{place}{error.strerror or error}; check the path, its permissions and the "
                    "space on the disk."
                ),
                2,
            )
        traceback.print_exception(error)
        words = (
            "this is a fault of starcal-uq and not of the input: report it with the lines above "
            "and the command."
        )
        _fail(f"{type(error).__name__}: {words}", FAULT)


def _catch(handler: Callable[[int, Any], None] | signal.Handlers) -> dict[signal.Signals, Any]:
    """Let a function take the signals that end a program; those of before, but for signals that
    were ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    caught = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in caught}


def _end_at_once(number: int, _frame: Any) -> None:
    """While loading, where an exception could be taken for that of a library that is missing."""
    os.write(2, b"error: interrupted before anything was begun.\n")
    os._exit(128 + number)


def _again(unraisable: Any) -> None:
    """An interrupt that came where none can be raised, such as in a finaliser, comes again a moment
    later.
    """
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(unraisable)


def _fail(message: str, status: int) -> None:
    from starcal_uq.cli.answers import deliver_error
    from starcal_uq.core.errors import printable

    # Names of files may hold anything, and a message is one line.
    sentence = printable(message.strip())
    print(f"error: {sentence}", file=sys.stderr)
    deliver_error(sentence, status)
    sys.exit(status)
