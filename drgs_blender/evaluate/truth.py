"""The ground truth of a capture, beyond its photographs.

`truth.json` beside it, as scenes.py writes it, or further captures of the same object under lights that the user names.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset import Asset, Mesh
from ..core.color import to_unit
from ..core.errors import AssetError
from ..deform.attach import attach
from ..formats.images import load_image
from ..formats.registry import read_environment
from ..reconstruct.capture.capture import RGB, View
from ..reconstruct.readers import read_capture
from ..reconstruct.readers.layout import read_json
from ..reconstruct.readers.photograph_loading import shrink
from ..render.film.frame_files import read_frame

Array = np.ndarray


@dataclass(slots=True)
class TruthSet:
    """Pictures of one light and pose.

    Attributes
    ----------
    name : str
        Shown in tables.
    light : str
        Its name.
    radiance : (h, w, 3) array
        Lat-long, Blender's mapping.
    posed : bool
        The object is deformed.
    views : list of View
        Views by Cycles, in the light's own exposure.
    maps : list of dict of str to (h, w, c) array
        Passes of each view: Coverage, and of Albedo, Roughness, Metallic, Normal, Depth what is known; empty where
        nothing is.
    background : tuple of float or None
        See `Capture`, of the views.
    """

    name: str
    light: str
    radiance: Array
    posed: bool
    views: list[View]
    maps: list[dict[str, Array]]
    background: RGB | None


@dataclass(slots=True)
class Truth:
    """Ground truth of a scene.

    Attributes
    ----------
    sets : list of TruthSet
        At least one.
    training_light : str
        Name of the light of the training views, "" where it is not known.
    rest, posed : (n, 3) float32 array, optional
        Vertices of the true mesh at rest and deformed; None where no set is posed.
    faces : (m, 3) int32 array, optional
        Of both.
    """

    sets: list[TruthSet]
    training_light: str = ""
    rest: Array | None = None
    posed: Array | None = None
    faces: Array | None = None


def read_truth(capture: Path) -> Truth | None:
    """The truth beside a capture (its folder, or a file in it); None where there is none.

    Raises
    ------
    AssetError
        It is there but damaged or not of this format.
    """
    folder = capture if capture.is_dir() else capture.parent
    file = folder / "truth.json"
    if not file.exists():
        return None
    data = read_json(file)
    if data.get("format") != 1:
        raise AssetError(str(file), f"is of format {data.get('format')!r}, not 1", "Make the scenes again")
    try:
        lights = {name: read_environment(folder / path).radiance for name, path in data["lights"].items()}
        sets = [_read_set(folder, item, lights) for item in data["sets"]]
        with np.load(folder / data["mesh"], allow_pickle=False) as mesh:
            rest, faces = mesh["vertices"], mesh["faces"]
        posed = np.load(folder / data["posed"], allow_pickle=False)
        training = str(data["training_light"])
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise AssetError(str(file), f"does not describe a scene ({error!r})", "Make the scenes again") from error
    if posed.shape != rest.shape:
        raise AssetError(str(file), "has a pose of another mesh", "Make the scenes again")
    return Truth(sets, training, rest, posed, faces)


def _read_set(folder: Path, item: dict[str, Any], lights: dict[str, Array]) -> TruthSet:
    name, light = str(item["name"]), str(item["light"])
    found = read_capture(folder / str(item["cameras"]), turntable="no")
    views = found.views
    maps = [read_frame(folder / name / f"{view.name}.exr")[0] for view in views] if item["maps"] else []
    return TruthSet(name, light, lights[light], bool(item["posed"]), views, maps, found.background)


def true_asset(folder: Path, density: float = 140.0) -> Asset:
    """The asset that a perfect reconstruction of a scene would be: true mesh, materials and light.

    What it scores is the ceiling of other assets. Its surfels are made from the mesh, `density` along its diagonal.
    """
    data = read_json(folder / "truth.json")
    with np.load(folder / data["mesh"], allow_pickle=False) as arrays:
        mesh = Mesh(*(arrays[name] for name in ("vertices", "faces", "albedo", "roughness", "metallic")))
    surfels, binding, _ = attach(mesh, None, density=density)
    light = read_environment(folder / data["lights"][data["training_light"]])
    return Asset(surfels, mesh, binding, light, {"source": f"truth of {folder.name}"})


def read_relit(
    capture: Path, light: Path, resolution: int | None = None, axes: str = "opengl", up: str | None = None
) -> TruthSet:
    """A capture of the object under a known light: its views left out, else all of them.

    Parameters
    ----------
    capture : Path
        Any layout; of one with several lights (TensoIR), the pictures of the light that is named as the file is.
    light : Path
        Lat-long environment, Blender's mapping.
    resolution : int, optional
    axes : str
    up : str, optional

    Raises
    ------
    AssetError
        The capture or the light cannot be read.
    """
    radiance = read_environment(light).radiance
    found = read_capture(capture, resolution, axes=axes, up=up, light=light.stem, turntable="no")
    views = found.testing or found.views
    maps = _tensoir_maps(capture, views)
    return TruthSet(light.stem, light.stem, radiance, False, views, maps, found.background)


def _tensoir_maps(capture: Path, views: list[View]) -> list[dict[str, Array]]:
    """Linear albedo and world-space normals, as TensoIR's set has them; empty where a view has none."""
    maps = []
    for view in views:
        files = [capture / view.name / name for name in ("albedo.png", "normal.png")]
        if view.mask is None or not all(file.is_file() for file in files):
            return []
        albedo, normal = (to_unit(load_image(file))[..., :3] for file in files)
        small = [shrink(image, view.camera.width, view.camera.height) for image in (albedo, normal)]
        maps.append({"Albedo": small[0], "Normal": 2 * small[1] - 1, "Coverage": view.mask[..., None]})
    return maps
