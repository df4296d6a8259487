"""Ctrl-C at a place of our choosing: between steps, not inside a library that reports it as a failure of its own."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the function that this yields is called.

    Yields
    ------
    callable
        Raises KeyboardInterrupt if Ctrl-C was pressed since the context was entered. In a thread other than the main
        one, which receives no signals, it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    pressed = threading.Event()

    def note(_signal: int, _frame: Any) -> None:
        pressed.set()

    def check() -> None:
        if pressed.is_set():
            pressed.clear()
            raise KeyboardInterrupt

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield check
        # Ctrl-C after the last step must not be lost.
        check()
    finally:
        signal.signal(signal.SIGINT, previous)
