"""The notebooks run from the first cell to the last, quietly."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"


@pytest.mark.parametrize(
    "name",
    [
        "quickstart",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("coupling_study", "error_budget", "paper")),
    ],
)
def test_it_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Jupyter's own files stay out of the home folder.
    for folder in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(folder, str(tmp_path / folder.lower()))
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOKS.parent))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel draws inline
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )

    client.execute()

    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    errors = [output.text for cell in cells for output in cell.outputs if output.get("name") == "stderr"]
    assert errors == []
    shown = [output.data for cell in cells for output in cell.outputs if output.output_type != "stream"]
    words = sum("text/html" in data or "text/markdown" in data for data in shown)
    assert words >= 4, "results show themselves as tables or in words"
    assert sum("image/png" in data for data in shown) >= 3, "figures are drawn"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of ArviZ 0.23 beside newer libraries
def test_the_page_on_own_tools_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """On either generation of ArviZ: `make test-other` runs it on the second one, `make docs` on the first."""
    for name in ("corner", "seaborn"):
        pytest.importorskip(name)
    import matplotlib.pyplot as plt

    page = (NOTEBOOKS.parent / "docs" / "how-to" / "own-tools.md").read_text(encoding="utf-8")
    cells = re.findall(r"^```{code-cell} python\n((?:^:[^\n]*\n)*)(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert len(cells) >= 8
    place: dict[str, object] = {}
    drawn = 0
    for tags, cell in cells:
        exec(compile(cell, cell.splitlines()[0], "exec"), place)
        assert tags or not plt.get_fignums(), "a figure of another library may come with warnings"
        drawn += bool(plt.get_fignums())
        plt.close("all")
    assert drawn == 5
