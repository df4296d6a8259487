"""A run as an executed notebook: its results in the order of a report, to go on from."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Collection, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from starcal_uq.core.errors import RunFolderError
from starcal_uq.core.extras import extra
from starcal_uq.core.remedy import RUN, Remedy
from starcal_uq.core.types import Progress
from starcal_uq.presentation.html import template_environment


def write_cells(name: str, parts: Collection[str], folder: str) -> Iterator[tuple[str, str]]:
    """Kind (``markdown``, ``code``, or ``parameters``) and source of each cell of the notebook on a
    run in `folder`.

    `parts` are names of the files that the run holds, such as ``posterior``, and ``effects`` where
    its calibration holds some.
    """
    written = Remedy("report", (RUN,), {"notebook": True}).command
    template = template_environment().get_template("notebook.txt.j2")
    text = template.render(name=name, parts=parts, folder=repr(folder), written=written)
    for number, cell in enumerate(text.split("```")):
        if number % 2:
            kind, _, source = cell.partition("\n")
            yield "parameters" if kind == "parameters" else "code", source.strip()
        elif cell.strip():
            yield "markdown", cell.strip()


def executed(
    cells: Iterator[tuple[str, str]], place: Path, progress: Progress | None = None
) -> str:
    """A notebook of these cells, as its file holds it, executed by this Python in the folder
    `place`.

    MissingExtraError if a library is not installed. RunFolderError if a cell fails.
    """
    with extra("notebook", "executed notebooks"):
        import ipykernel  # noqa: F401
        import nbformat.v4
        from jupyter_client.kernelspec import KernelSpec
        from jupyter_client.manager import AsyncKernelManager
        from nbclient import NotebookClient
        from nbclient.exceptions import CellExecutionError, DeadKernelError

    class ThisPython(AsyncKernelManager):
        """Whatever kernels are installed, this interpreter has the package."""

        @property
        def kernel_spec(self) -> KernelSpec:
            command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
            return KernelSpec(argv=command, display_name="Python 3", language="python")

    make: Any = nbformat.v4
    write: Any = nbformat.writes
    made = []
    for number, (kind, source) in enumerate(cells):
        cell = make.new_markdown_cell(source) if kind == "markdown" else make.new_code_cell(source)
        # The same for the same run; as a rule they are random.
        cell["id"] = f"cell-{number}"
        if kind == "parameters":
            cell["metadata"]["tags"] = ["parameters"]
        made.append(cell)
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    notebook = make.new_notebook(cells=made, metadata=kernel)
    with TemporaryDirectory(ignore_cleanup_errors=True) as own:
        # The kernel draws inline, whatever this process draws with.
        env = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"} | {
            "IPYTHONDIR": own
        }
        client = NotebookClient(
            notebook,
            kernel_manager_class=ThisPython,
            timeout=None,
            resources={"metadata": {"path": str(place)}},
            record_timing=False,
            on_cell_complete=lambda cell, cell_index: (
                progress(cell_index + 1, len(made)) if progress else None
            ),
        )
        handlers = _handlers()
        try:
            client.execute(env=env, stderr=subprocess.DEVNULL)
        except Exception as error:
            # A signal makes the client end the kernel, after which it fails in one way or another.
            if hasattr(client, "_async_cleanup_kernel_future"):
                raise KeyboardInterrupt from None
            if isinstance(error, DeadKernelError):
                raise RunFolderError(
                    "the notebook's kernel ended unexpectedly: is there enough memory?"
                ) from None
            if not isinstance(error, CellExecutionError):
                raise
            said = f"{error.ename}: {error.evalue}".splitlines()[0]
            raise RunFolderError(
                f"a cell of the notebook failed ({said}): try `{Remedy('report', (RUN,)).words}`."
            ) from None
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return str(write(notebook)) + "\n"


def _handlers() -> dict[signal.Signals, Any]:
    """What takes the signals now, where this thread may say so: the client of the notebook takes
    them meanwhile.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
