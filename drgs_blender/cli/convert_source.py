"""The input of ``drgs convert``: splats, mesh and light of a file, where it has them; Z up, in the chosen colour."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..core.asset import OPTIONAL_CHANNELS, Asset, Environment, Mesh, Surfels
from ..core.asset.model import BASE_CHANNELS, MATERIAL_CHANNELS, neutral_values
from ..core.errors import UsageError
from ..core.file_types import Held
from ..core.frame import RenderSettings, World
from ..formats.splats import Splats, join_splats, splats_of
from .placed_frame import surface_frame
from .pose_file import in_asset_order, read_vertices
from .progress import FractionBar
from .relight import read_environment, rotation_z

if TYPE_CHECKING:
    from ..core.asset.textures import MeshTextures
    from ..engine.session import PosedObject, Session
    from ..formats.usd_sequence import MovingObject

Array = np.ndarray

_COLOUR_NAMES = {
    "captured": "captured colour",
    "albedo": "albedo",
    "relit": "colour under the environment",
    "scene": "colour in the light of the scene",
}
#: Rows of an environment that has no picture.
_UNIFORM_ROWS = 8


class Source(Protocol):
    """Content of a file to be converted.

    Attributes
    ----------
    kinds : tuple of {"splats", "mesh", "environment"}
        Best first.
    notes : list of str
        Conversions and assumptions of its reader.
    """

    kinds: tuple[Held, ...]
    notes: list[str]

    def splats(self) -> tuple[Splats, str]:
        """The splats, and what their colour is."""

    def mesh(self) -> Mesh:
        """The mesh with its materials."""

    def environment(self) -> Environment:
        """The light."""

    def moving(self, meshes: bool, surfels: bool) -> list[MovingObject]:
        """The objects one by one; their surfels where they are asked for, or where there is no mesh."""


def open_source(args: argparse.Namespace) -> Source:
    """Read ``args.input``. Raises AssetError, or UsageError for options that do not go with it."""
    from ..formats.axes import surfels_to_z_up
    from ..formats.files import EnvironmentFile, MeshFile, SurfelFile
    from ..formats.registry import read
    from ..ipc.frame_file import SUFFIX

    suffix = args.input.suffix.lower()
    if suffix in (".drgs", SUFFIX) and args.from_up not in (None, "z"):
        raise UsageError("--from-up", "is given for a file that is always Z up", "Leave it out")
    if suffix == ".drgs":
        from ..core.asset.container import read_asset

        return AssetSource(args, read_asset(args.input))
    if args.vertices:
        raise UsageError("--vertices", "poses an asset, but the input is none", "Leave it out")
    if suffix == SUFFIX:
        frame = FrameSource(args)
        check_objects(args, frame.names)
        return frame
    file = read(args.input)
    if isinstance(file, SurfelFile):
        surfels = surfels_to_z_up(file.surfels, args.from_up or file.up or "z")
        # Splats go out as they came in, unless it is their albedo that is wanted.
        bare = args.colour != "albedo" and not args.materials
        notes = [note for note in file.notes if not (bare and note in file.assumed)]
        return AssetSource(args, Asset(surfels, Mesh.empty()), notes)
    if isinstance(file, EnvironmentFile):
        return AssetSource(args, Asset(_nothing(), Mesh.empty(), environment=file.environment), file.notes)
    if isinstance(file, MeshFile):
        from ..build.make import MAX_TEXTURE, mesh_with_materials

        mesh, report = mesh_with_materials(file, str(args.input), up=args.from_up, max_texture=MAX_TEXTURE)
        return AssetSource(args, Asset(_nothing(), mesh), report["notes"])
    raise UsageError(str(args.input), "holds materials alone", "Make an asset of it and its mesh first")


def check_objects(args: argparse.Namespace, seen: Sequence[str]) -> None:
    """Refuse an ``--object`` that is not among those that are seen, of one frame or of all."""
    if unseen := [name for name in args.object or () if name not in seen]:
        known = ", ".join(dict.fromkeys(seen)) or "none"
        problem = f"is no DR-GS object that the camera sees in {args.scene or args.input}, which has {known}"
        remedy = "Choose one of them" if seen else "Show it in renders, or choose other frames"
        raise UsageError(f"--object {unseen[0]}", problem, remedy)


class AssetSource:
    """An asset, or what another file holds of one."""

    def __init__(self, args: argparse.Namespace, asset: Asset, notes: list[str] | None = None) -> None:
        self._args, self._asset, self.notes = args, asset, notes or []
        self._vertices = asset.mesh.vertices
        self._posed = args.vertices is not None
        if self._posed:
            self._vertices = in_asset_order(args, asset.mesh, read_vertices(args.vertices, args.frame))
            if bad := int((~np.isfinite(self._vertices)).any(axis=1).sum()):
                note = f"--vertices {args.vertices}: {bad} vertices are NaN or infinite; what hangs on them is left out"
                self.notes = [*self.notes, note]
        held: dict[Held, bool] = {
            "mesh": len(asset.mesh.faces) > 0,
            "splats": len(asset.surfels) > 0,
            "environment": asset.environment is not None,
        }
        self.kinds: tuple[Held, ...] = tuple(kind for kind, there in held.items() if there)
        if not self.kinds:
            raise UsageError(str(args.input), "has neither splats nor a mesh nor light", "Choose another file")

    def environment(self) -> Environment:
        """The light of the file."""
        assert self._asset.environment is not None
        return self._asset.environment

    def mesh(self) -> Mesh:
        """The mesh, posed."""
        return posed_mesh(self._asset.mesh, self._vertices) if self._posed else self._asset.mesh

    def moving(self, meshes: bool, surfels: bool) -> list[MovingObject]:
        """The asset, named as its file, or as those of all frames."""
        from ..formats.usd_sequence import MovingObject

        mesh = self.mesh() if "mesh" in self.kinds and meshes else None
        splats = self.splats()[0] if "splats" in self.kinds and (surfels or mesh is None) else None
        return [MovingObject(self._args.name, mesh, np.eye(4), splats=splats)]

    def splats(self) -> tuple[Splats, str]:
        """The surfels, posed, in the colour that was chosen."""
        args, asset, surfels = self._args, self._asset, self._asset.surfels
        if self._posed:
            from ..build.export import posed_surfels

            surfels = posed_surfels(asset, self._vertices)
        from ..build.export import faded

        surfels = faded(surfels, asset, asset.mesh.opacity)
        choice = args.colour or ("relit" if args.env else "captured")
        emission = asset.surfels.emission
        if emission is not None:
            lost = "is left out" if choice != "relit" else "is seen, but lights nothing else"
            self.notes = [*self.notes, f"what the surfels emit {lost}"]
        if choice != "relit":
            return _unlit(surfels, choice)
        from ..build.relit import relit_colours

        args.asset = args.input  # as `drgs relight` names it in messages
        world = World(read_environment(args, asset), rotation_z(args.env_rotation), strength=args.env_strength)
        settings = RenderSettings(samples=args.samples, subpixel_samples=1)
        with FractionBar(args, "lighting") as progress:
            colour = relit_colours(asset, surfels, self._vertices, world, settings, progress)
        colour = colour if emission is None else colour + emission
        return splats_of(surfels, colour), _COLOUR_NAMES["relit"]


class FrameSource:
    """The DR-GS objects that the camera may see in a frame of Blender's, where they are in the world, and the light.

    Attributes
    ----------
    names : list of str
        The objects, those that ``--object`` leaves out among them.
    """

    def __init__(self, args: argparse.Namespace, session: Session | None = None) -> None:
        from ..engine.session import Session

        if args.env:
            raise UsageError("--env", "is given for a frame, which has its own light", "Leave it out")
        self._args, session = args, session or Session()
        self._frame = surface_frame(args.input, args.samples, session)
        self.notes: list[str] = []
        self._prepared, self._objects = session.prepare(self._frame)
        if self._prepared.surfel_bvh is None and any(item.asset.binding is None for item in self._objects):
            # Sheets would shade what lies on them.
            self._frame = replace(self._frame, settings=replace(self._frame.settings, rays_see="surfels"))
            self._prepared, self._objects = session.prepare(self._frame)
        self._visible = [i for i, item in enumerate(self._objects) if item.state.visibility.camera]
        self.names = [self._objects[i].state.name for i in self._visible]
        if args.object:
            self._visible = [i for i in self._visible if self._objects[i].state.name in args.object]
        self._session = session  # keeps the scene
        faces = any(len(self._objects[i].mesh.faces) for i in self._visible)
        kinds: list[Held] = ["mesh"] if faces else []
        self.kinds: tuple[Held, ...] = (*kinds, "splats", "environment") if self._visible else ("environment",)

    def environment(self) -> Environment:
        """The World, turned as it is in the scene."""
        from ..formats.latlong import directions

        picture = self._frame.world.environment
        look = directions(_UNIFORM_ROWS if picture is None else len(picture))
        radiance = self._prepared.environment.lookup(look.reshape(-1, 3).astype(np.float32)).reshape(look.shape)
        return Environment(radiance)

    def mesh(self) -> Mesh:
        """All meshes as one, with the materials they have in the frame."""
        meshes = [self._objects[i].mesh for i in self._visible]
        first = np.cumsum([0, *(len(m.vertices) for m in meshes)])

        def joined(name: str) -> Array:
            return np.concatenate([getattr(mesh, name) for mesh in meshes])

        return Mesh(
            joined("vertices"),
            np.concatenate([m.faces + start for m, start in zip(meshes, first, strict=False)]),
            joined("albedo"),
            joined("roughness"),
            joined("metallic"),
            **self._optional_channels(),
            textures=self._textures(),
        )

    def _textures(self) -> MeshTextures | None:
        """The images of all meshes, where one has some; of those that are painted or adjusted none."""
        from ..core.asset.textures import join_textures, no_textures
        from ..formats.mesh_groups import corner_normals

        parts, normals, shaped = [], [], False
        for i in self._visible:
            item = self._objects[i]
            state, rest, traced = item.state, item.asset.mesh, item.mesh
            own, part = self._own_textures(item, state.name), no_textures(len(traced.faces))
            mesh = Mesh(traced.vertices, traced.faces, traced.albedo, traced.roughness, traced.metallic)
            shading = corner_normals(mesh)
            if own is not None and len(own.material) == len(traced.faces):
                mirrored = [0, 2, 1] if _mirrors(state.matrix_world) else [0, 1, 2]  # as the corners of `traced`
                part = replace(own, uvs=own.uvs[:, mirrored], normals=None)
                vertices = rest.vertices if state.vertices is None else state.vertices
                posed = posed_mesh(replace(rest, textures=own), vertices).textures
                given = state.corner_normals if state.corner_normals is not None or posed is None else posed.normals
                if given is not None:
                    shading = given[:, mirrored] @ np.linalg.inv(state.matrix_world[:3, :3])
                    shading = shading / np.maximum(np.linalg.norm(shading, axis=2, keepdims=True), 1e-30)
                    shaped = True
            parts.append(part)
            normals.append(shading.astype(np.float32))
        if all(not part.names for part in parts):
            return None
        return join_textures(parts, np.concatenate(normals) if shaped else None)

    def _own_textures(self, item: PosedObject, name: str) -> MeshTextures | None:
        """The images of an object; a note where they are left out."""
        state, textures = item.state, item.asset.mesh.textures
        bare = state.adjustment is None and all(getattr(state, channel) is None for channel in MATERIAL_CHANNELS)
        if textures is not None and not bare:
            note = f"{name}: is painted or adjusted, so its images are left out for the materials of its vertices"
            self.notes.append(note)
        return textures if bare else None

    def _optional_channels(self) -> dict[str, Any]:
        """Optional channels of all meshes; neutral where one lacks what another has."""
        items = [self._objects[i] for i in self._visible]
        names = [name for name in OPTIONAL_CHANNELS if any(name in item.channels for item in items)]

        def values(item: PosedObject, name: str) -> Array:
            return item.channels.get(name, neutral_values(name, len(item.mesh.vertices)))

        return {name: np.concatenate([values(item, name) for item in items]) for name in names}

    def splats(self) -> tuple[Splats, str]:
        """The surfels of all objects, in the colour that was chosen."""
        choice = self._args.colour or "captured"
        if choice != "relit":
            parts = [_unlit(self._surfels(i), choice) for i in self._visible]
            glowing = [self._objects[i].state.name for i in self._visible if self._objects[i].emission is not None]
            self.notes += [f"{name}: what its surfels emit is left out" for name in glowing]
            return join_splats([splats for splats, _ in parts]), " or the ".join(dict.fromkeys(s for _, s in parts))
        with FractionBar(self._args, "lighting") as progress:
            lit = [self._lit(i, progress) for i in self._visible]
        return join_splats(lit), _COLOUR_NAMES["scene"]

    def moving(self, meshes: bool, surfels: bool) -> list[MovingObject]:
        """The objects; instances of one get numbers that no other object has in its name."""
        names: dict[str, None] = {}
        own = {item.state.name for item in self._objects}
        for i in self._visible:
            name = self._objects[i].state.name
            numbered = (f"{name}.{k:03d}" for k in itertools.count(1))
            names[name if name not in names else next(n for n in numbered if n not in names and n not in own)] = None
        return [self._moving(i, name, meshes, surfels) for i, name in zip(self._visible, names, strict=True)]

    def _moving(self, index: int, name: str, meshes: bool, surfels: bool) -> MovingObject:
        from ..formats.mesh_groups import corner_normals
        from ..formats.usd_sequence import MovingObject

        item = self._objects[index]
        state, traced, mesh = item.state, item.mesh, None
        normals = state.corner_normals
        if meshes and len(traced.faces):
            rest = item.asset.mesh
            textures = self._own_textures(item, name)
            mesh = posed_mesh(rest, rest.vertices if state.vertices is None else state.vertices)
            if normals is None and mesh.textures is not None and mesh.textures.normals is not None:
                normals = corner_normals(mesh)  # which stay where the images do not
            values = {channel: getattr(traced, channel) for channel in BASE_CHANNELS} | item.channels
            mesh = replace(mesh, **values, textures=None if textures is None else mesh.textures)
            if traced.torn is not None and traced.torn.any():
                self.notes.append(f"{name}: has torn faces, which are written stretched over the gap, not closed")
            if state.particles is not None and state.particles.skin:
                self.notes.append(f"{name}: is shown by a surface of its particles; its own mesh is written instead")
        splats = None
        if surfels or mesh is None:
            if self._args.colour == "relit":
                with FractionBar(self._args, "lighting") as progress:
                    splats = self._lit(index, progress)
            else:
                splats = _unlit(self._surfels(index), self._args.colour or "captured")[0]
        return MovingObject(name, mesh, state.matrix_world, normals, splats)

    def _surfels(self, index: int) -> Surfels:
        from ..build.export import faded, surfels_of_pose

        item = self._objects[index]
        posed = surfels_of_pose(item.asset.surfels, item.surfels, mirrored=_mirrors(item.state.matrix_world))
        return faded(posed, item.asset, item.channels.get("opacity"))

    def _lit(self, index: int, progress: FractionBar) -> Splats:
        from ..build.relit import both_sides, lit_colours, own_surfels, points_on_mesh

        item, surfels, tree = self._objects[index], self._surfels(index), self._prepared.surfel_bvh
        size = 0.0 if tree is None else float(tree.sizes(len(self._objects))[index])
        prepared, settings = self._prepared, self._frame.settings
        light, lights = prepared.environment, prepared.lights
        if item.asset.binding is None:
            assert tree is not None  # `__init__` sees to it
            colour = both_sides(prepared.scene, light, surfels, index, size, settings, lights, tree, progress)
        else:
            faces, binding = item.asset.mesh.faces, item.asset.binding
            mirrored = _mirrors(item.state.matrix_world)
            points = points_on_mesh(surfels, item.mesh.vertices, faces, binding, mirrored=mirrored)
            points = points if tree is None else own_surfels(points, index, size)
            colour = lit_colours(prepared.scene, light, points, settings, lights, tree, progress)
        return splats_of(surfels, colour if item.emission is None else colour + item.emission)


def posed_mesh(rest: Mesh, vertices: Array) -> Mesh:
    """A mesh at other vertices (n, 3), the normals of its textures with them."""
    textures = rest.textures
    if textures is not None and textures.normals is not None:
        from ..deform.face_frames import local_normals, posed_normals

        local = local_normals(rest.vertices, rest.faces, textures.normals)
        textures = replace(textures, normals=posed_normals(vertices, rest.faces, local))
    return replace(rest, vertices=vertices, textures=textures)


def _unlit(surfels: Surfels, choice: str) -> tuple[Splats, str]:
    """Splats in the captured colour or the albedo, and which of them it is."""
    if choice == "albedo" or surfels.sh is None:
        return splats_of(surfels, surfels.albedo), _COLOUR_NAMES["albedo"]
    return splats_of(surfels), _COLOUR_NAMES["captured"]


def _mirrors(matrix: Array) -> bool:
    return bool(np.linalg.det(matrix[:3, :3]) < 0)


def _nothing() -> Surfels:
    """No surfels."""
    rows, numbers = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    return Surfels(rows, rows[:, :2], np.empty((0, 4), np.float32), numbers, rows, numbers, numbers)
