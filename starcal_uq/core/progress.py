"""A bar for whoever calls a function that tells its progress, in a notebook or a terminal."""

from __future__ import annotations

import math
import sys
import time
import uuid
from html import escape
from typing import Any

_EVERY_S = 0.2


class ProgressBar:
    """One line that follows long work: ``sc.sample(obs, cal,
    progress=sc.core.ProgressBar("sampling"))``.

    In a notebook it is one output, which is replaced and stays when the work is done; in a terminal
    one line on standard error; elsewhere nothing.

    Parameters
    ----------
    label : str
        What is being done.
    """

    def __init__(self, label: str = "") -> None:
        self._label, self._shown_at, self._begun = label, -math.inf, False
        self._place = {"display_id": f"progress-{uuid.uuid4().hex}"}
        shell = _shell()
        self._publish = shell.display_pub.publish if hasattr(shell, "kernel") else None

    def __call__(self, done: int, total: int) -> None:
        """Move to `done` of `total`; five times a second at most is shown, and the end."""
        now = time.monotonic()
        if done < total and now - self._shown_at < _EVERY_S:
            return
        self._shown_at = now
        said = f"{self._label} {done} of {total}".strip()
        if self._publish is not None:
            html = f'<progress value="{done}" max="{total}"></progress> {escape(said)}'
            self._publish(
                {"text/html": html, "text/plain": said}, transient=self._place, update=self._begun
            )
            self._begun = True
        elif sys.stderr.isatty():
            print(f"\r{said}", end="\n" if done >= total else "", file=sys.stderr, flush=True)


def _shell() -> Any:
    """The running IPython; None where there is none, and none is loaded to find out."""
    module = sys.modules.get("IPython")
    return None if module is None else module.get_ipython()
