"""The notebooks run from the first cell to the last, quietly."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from jupyter_client.manager import start_new_kernel
from nbclient import NotebookClient

import starcal_uq as sc
from starcal_uq.core.errors import RunFolderError
from starcal_uq.presentation.pages.notebook import executed, write_cells
from tests.helpers.scenes import observations

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"


def at_home(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Jupyter's own files stay out of the home folder."""
    for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(folder / name.lower()))
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOKS.parent))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "coupling_study",
        "error_budget",
        "model_comparison",
        "own_images",
        "quickstart",
        "requirement",
    ],
)
def test_it_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    at_home(tmp_path, monkeypatch)
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel draws inline
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    client = NotebookClient(
        notebook,
        timeout=300,
        kernel_name="python3",
        resources={"metadata": {"path": str(tmp_path)}},
    )

    client.execute()

    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    errors = [
        output.text for cell in cells for output in cell.outputs if output.get("name") == "stderr"
    ]
    assert errors == []
    shown = [
        output.data for cell in cells for output in cell.outputs if output.output_type != "stream"
    ]
    words = sum("text/html" in data or "text/markdown" in data for data in shown)
    assert words >= 4, "results show themselves as tables or in words"
    assert sum("image/png" in data for data in shown) >= 3, "figures are drawn"


def test_cells_of_a_run_are_those_of_what_it_holds() -> None:
    cells = list(write_cells("night", ["observations", "calibration"], "/data/night"))
    assert cells[1] == ("parameters", "folder = '/data/night'")
    source = "\n".join(text for _, text in cells)
    assert "run.calibration" in source
    assert not {"posterior", "attitude", "budget", "images"} & set(
        re.findall(r"run\.(?:error_|shown_)?(\w+)", source)
    )
    for kind, text in cells:
        if kind != "markdown":
            compile(text, "cell", "exec")


@pytest.mark.slow
def test_a_run_becomes_a_notebook_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOKS.parent))
    monkeypatch.setenv("MPLBACKEND", "Agg")  # the kernel draws inline all the same
    run = sc.Run(tmp_path / "run")
    run.calibrate(observations(n_frames=30), sc.paper.paper_start())
    run.sample(n_steps=50, seed=1)
    with pytest.raises(RunFolderError, match=r"ZeroDivisionError: division by zero"):
        executed(iter([("code", "1 / 0")]), tmp_path)
    path = run.notebook()
    assert path == run.path / "report.ipynb"
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    first, *others = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert (first.source, first.metadata["tags"], first.outputs) == (
        "folder = '.'",
        ["parameters"],
        [],
    )
    outputs = [output for cell in others for output in cell.outputs]
    assert all(len(cell.outputs) == 1 for cell in others), (
        "every cell shows one thing, and no stream"
    )
    assert sum("image/png" in output.data for output in outputs) == 5
    assert run.verdict.headline in outputs[0].data["text/plain"]
    with pytest.raises(RunFolderError):
        run.notebook()
    run.sample(n_steps=20, seed=2, force=True)
    assert not path.exists(), "it is of a posterior that is gone"


@pytest.mark.slow
def test_an_interrupted_cell_leaves_the_session_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stop button of a notebook, while `Run.sample` and `sc.sample` work."""
    at_home(tmp_path, monkeypatch)
    monkeypatch.chdir(tmp_path)
    run = sc.Run(tmp_path / "run")
    run.calibrate(observations(n_frames=12), sc.paper.paper_start())
    seen: list[str] = []
    manager, client = start_new_kernel(kernel_name="python3")

    def cell(source: str, stop: str = "\0") -> str:
        """The name of the error that a cell ends with; stopped when it has printed `stop`."""

        def printed(message: dict[str, Any]) -> None:
            seen.append(message["content"].get("text", ""))
            if stop in seen[-1]:
                manager.interrupt_kernel()

        content = client.execute_interactive(source, output_hook=printed, timeout=120)["content"]
        return str(content.get("ename", ""))

    try:
        assert not cell(
            "import numpy as np, starcal_uq as sc\n"
            "run = sc.Run('run')\n"
            "short = dict(seed=1, n_ensembles=2, n_walkers=14, n_steps=400)\n"
            "def told(done, total):\n"
            "    if done == 300: print('far enough', flush=True)\n"
            "    if done > 300: time.sleep(0.01)\n"
            "import time"
        )
        assert cell("run.sample(**short, progress=told)", "far enough") == "KeyboardInterrupt"
        assert cell(
            "sc.sample(run.observations, run.calibration, **short, progress=told)", "far enough"
        )
        # What was done is kept, nothing else is, and the same cell goes on.
        assert [path.name for path in run.path.glob("*checkpoint*")] and not run.has("posterior")
        assert not cell(
            "steps = []\n"
            "post = run.sample(**short, progress=lambda done, total: steps.append(done))\n"
            "whole = sc.sample(run.observations, run.calibration, **short)\n"
            "assert steps[0] > 250, steps[0]\n"
            "assert np.array_equal(post.draws, whole.draws)\n"
            "print('the same', flush=True)"
        )
        assert "the same\n" in seen
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
    assert run.has("posterior") and not list(run.path.glob("*checkpoint*"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of ArviZ 0.23 beside newer libraries
def test_the_page_on_own_tools_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """On either generation of ArviZ: `make test-other` runs it on the second one, `make docs` on
    the first.
    """
    for name in ("corner", "seaborn"):
        pytest.importorskip(name)
    import matplotlib.pyplot as plt

    page = (NOTEBOOKS.parent / "docs" / "how-to" / "own-tools.md").read_text(encoding="utf-8")
    cells = re.findall(
        r"^```{code-cell} python\n((?:^:[^\n]*\n)*)(.*?)^```$", page, re.MULTILINE | re.DOTALL
    )
    assert len(cells) >= 8
    place: dict[str, object] = {}
    drawn = 0
    for tags, cell in cells:
        exec(compile(cell, cell.splitlines()[0], "exec"), place)
        assert tags or not plt.get_fignums(), "a figure of another library may come with warnings"
        drawn += bool(plt.get_fignums())
        plt.close("all")
    assert drawn == 5
