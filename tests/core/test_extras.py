"""What only some users need: where it is missing, one sentence says how to install it."""

import gc
import re
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import starcal_uq as sc
from starcal_uq.cli.app import main
from starcal_uq.core.cluster import cluster
from starcal_uq.core.errors import MissingExtraError
from starcal_uq.images.detection import DetectionOptions, find_stars
from starcal_uq.images.image import Image
from starcal_uq.likelihood import paths
from starcal_uq.presentation.pages.budgeting import write_xlsx
from starcal_uq.presentation.pages.notebook import executed

PREVIOUS = Path(__file__).parents[1] / "runs" / "data" / "previous"


def hide(monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    """With what is imported of it already."""
    # What other tests left, such as a client without a scheduler, imports when it is removed.
    gc.collect()
    for name in [library, *(name for name in sys.modules if name.startswith(f"{library}."))]:
        monkeypatch.setitem(sys.modules, name, None)


def on_processes(**where: Any) -> None:
    with cluster(**where):
        pass


def export(to: str, folder: Path) -> None:
    sc.export(sc.Camera.load(PREVIOUS / "camera.toml"), to, folder / "camera")


def image(name: str, content: bytes, folder: Path) -> None:
    (folder / name).write_bytes(content)
    sc.images.read_image(folder / name)


def ecsv(folder: Path) -> None:
    sc.load_observations(PREVIOUS / "observations.parquet").save(folder / "a.ecsv")


def stars(folder: Path) -> None:
    counts = np.random.default_rng(1).normal(100.0, 3.0, (64, 64))
    find_stars(Image(counts, "a.png"), DetectionOptions())


# What asks for a library: the library, the extra that brings it, and how it is asked for.
NEEDS: dict[str, tuple[str, str, Callable[[Path], Any]]] = {
    "a.fits: FITS images": ("astropy", "images", partial(image, "a.fits", b"SIMPLE  ")),
    "ECSV tables": ("astropy", "images", ecsv),
    "FITS headers": ("astropy", "images", partial(export, "sip")),
    "star images": ("sep", "images", stars),
    "a.nef: raw files of cameras": ("rawpy", "raw", partial(image, "a.nef", b"any")),
    "Excel workbooks": ("openpyxl", "excel", lambda folder: write_xlsx(Any, folder / "a.xlsx")),
    "ASDF files": ("asdf", "asdf", partial(export, "asdf")),
    "cameras for tetra3rs": ("tetra3rs", "tetra3rs", partial(export, "tetra3rs")),
    "compiled kernels": ("numba", "compiled", lambda _: paths.use("numba")),
    "Dask schedulers": (
        "distributed",
        "cluster",
        lambda _: on_processes(scheduler="tcp://127.0.0.1:1"),
    ),
    "executed notebooks": ("ipykernel", "notebook", partial(executed, iter([]))),
}


@pytest.mark.parametrize("what", NEEDS)
def test_a_missing_library_is_named_with_the_command_that_installs_it(tmp_path, monkeypatch, what):
    library, extra, ask = NEEDS[what]
    hide(monkeypatch, library)
    words = f'{what} need {library}: run `pip install "starcal-uq[{extra}]"`'
    with pytest.raises(MissingExtraError, match=re.escape(words)) as error:
        ask(tmp_path)
    assert str(error.value).endswith(".")
    assert {path.suffix for path in tmp_path.iterdir()} <= {
        ".fits",
        ".ecsv",
        ".nef",
    }  # nothing half written


def test_what_needs_no_extra_does_not_ask_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes of this machine need no Dask."""
    hide(monkeypatch, "distributed")
    hide(monkeypatch, "astropy")
    assert sc.example_data("esa").observations.n_frames == 8  # an ECSV table
    with cluster(workers=2, caller="a test") as here:
        assert here.map(abs, [-1, 2]) == [1, 2]


def test_a_command_ends_with_status_2(tmp_path, monkeypatch, capsys):
    hide(monkeypatch, "astropy")
    (tmp_path / "night.fits").write_bytes(b"SIMPLE  ")
    arguments = [
        "run",
        str(tmp_path / "night.fits"),
        str(PREVIOUS / "camera.toml"),
        "-o",
        str(tmp_path / "run"),
    ]
    monkeypatch.setattr(sys, "argv", ["starcal-uq", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err.strip()
    assert (ended.value.code, said.count("\n")) == (2, 0)
    assert 'FITS images need astropy: run `pip install "starcal-uq[images]"`' in said
