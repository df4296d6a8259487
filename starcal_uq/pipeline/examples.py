"""Real data that come with the package, for the tour, for tests and for a first try."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from starcal_uq.camera.camera import Camera
from starcal_uq.core.display import Shown
from starcal_uq.core.errors import SettingError
from starcal_uq.core.files import atomic_write_bytes, ensure_new, new_folder, shown
from starcal_uq.core.settings import ExampleName
from starcal_uq.core.types import PathLike
from starcal_uq.observations.table import load_observations
from starcal_uq.sky.site import Site

if TYPE_CHECKING:
    from starcal_uq.observations.table import Observations

_DATA = Path(__file__).parent / "data"


@dataclass(frozen=True)
class ExampleData(Shown):
    """A table of stars measured in real images, with what is known of camera and place.

    Attributes
    ----------
    name : str
        Name of the example.
    observations : Observations
        Stars as they were measured and identified; the directions are the catalogue's, so that
        ``sc.sky.make_apparent(observations, site=site)`` comes first.
    camera : Camera
        The nominal camera, from data sheets.
    site : Site
        Where the camera stood, as far as it is known.
    notice : str
        Who made the data, under which licence, and what was done to them.
    """

    name: str
    observations: Observations
    camera: Camera
    site: Site
    notice: str

    def save(self, folder: PathLike, force: bool = False) -> list[Path]:
        """Write ``stars.ecsv``, ``camera.toml``, ``site.toml`` and ``NOTICE`` into a folder, which
        is made.

        Parameters
        ----------
        folder : path
            The folder.
        force : bool
            Whether files may be replaced.

        Returns
        -------
        list of Path
            The files.

        Raises
        ------
        RunFolderError
            If a file exists, or cannot be written.
        """
        contents = {
            Path(folder) / path.name: path.read_bytes()
            for path in sorted((_DATA / self.name).iterdir())
        }
        for path in contents:
            ensure_new(path, force)
        new_folder(folder)
        for path, content in contents.items():
            atomic_write_bytes(path, content)
        return list(contents)


def example_data(name: ExampleName = "esa") -> ExampleData:
    """Real data that come with the package.

    Parameters
    ----------
    name : {"esa"}
        ``esa``: eight frames of the night sky by the European Space Agency, 402 stars, a lens of 35
        mm on the ground.

    Returns
    -------
    ExampleData
        Observations, nominal camera, site, and the licence (CC BY-SA 3.0 IGO).

    Raises
    ------
    SettingError
        If there is no example of that name.
    """
    if name not in get_args(ExampleName):
        raise SettingError(f"name is {shown(name)}: use one of {', '.join(get_args(ExampleName))}.")
    folder = _DATA / name
    camera = Camera.load(folder / "camera.toml")
    return ExampleData(
        name=name,
        observations=load_observations(folder / "stars.ecsv", camera),
        camera=camera,
        site=Site.load(folder / "site.toml"),
        notice=(folder / "NOTICE").read_text(encoding="utf-8"),
    )
