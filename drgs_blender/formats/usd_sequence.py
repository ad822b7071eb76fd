"""Moving objects as one USD stage, as Blender's own exporter writes them: a sample for each frame, written by usd-core.

``/root/<object>`` has the object's transform, the mesh below it (and simulated particles) in object space; its surfels
are ``/root/<object>_surfels``, in world space. What stays the same in all frames has no samples.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset import Mesh
from ..core.asset.archive import replace_by, replace_file
from ..core.asset.model import neutral_values
from ..core.errors import AssetError, UsageError, WriteError
from ..core.file_types import USD_KERNELS
from ..core.version import __version__
from ..geometry.normals import VertexNormals
from .mesh_groups import corner_normals, face_groups
from .splats import Splats, writable
from .usd_mesh import material_text, picture_files, write_package
from .usd_samples import Samples
from .usd_splats import check_usd, define_field, field_values

Array = np.ndarray

#: Attributes of the mesh that Blender reads as those which DR-GS objects have there.
_CHANNELS = ("albedo", "roughness", "metallic", "opacity", "emission", "specular", "coat")
#: Bytes that a zip without extensions holds.
_LARGEST_PACKAGE = 0xFFFF0000
#: Vertices and surfels of frames that are held in memory before they are written, 100 bytes and more each.
_HELD = 1 << 21


@dataclass(slots=True)
class MovingObject:
    """An object in one frame.

    Attributes
    ----------
    name : str
        The same in all frames, and of no other object.
    mesh : Mesh, optional
        Object space, Z up, metres.
    matrix_world : (4, 4) array
        Object to world.
    normals : (m, 3, 3) float32 array, optional
        Unit, object space, of the mesh's face corners; None: those of its textures, else smooth ones.
    splats : Splats, optional
        Its surfels, world space.
    points : (k, 3) array, optional
        Simulated particles, object space.
    """

    name: str
    mesh: Mesh | None
    matrix_world: Array
    normals: Array | None = None
    splats: Splats | None = None
    points: Array | None = None


def write_usd_sequence(
    path: Path,
    frames: Iterable[tuple[int, list[MovingObject]]],
    fps: float,
    *,
    kernel: str = USD_KERNELS[0],
    materials: bool = False,
) -> list[str]:
    """Write a stage, Z up, in metres, whose time codes are the numbers of the frames; return what is to be told.

    Frames are written as they come, and not held in memory; the file is put in place when it is whole. Images lie
    beside the stage, in the folder ``<stem>_textures`` (an @ of the stem is _), or are in a USDZ.

    Parameters
    ----------
    path : Path
        Ends in one of `file_types.USD_SUFFIXES`.
    frames : iterable of (int, list of MovingObject)
        By ascending number.
    fps : float
        Frames per second.
    kernel : str
    materials : bool
        As `usd_splats.write_usd_splats`.

    Raises
    ------
    DeviceError
        usd-core is not installed.
    AssetError, UsageError
        An object has other faces or another number of surfels than in a frame before; or what the writers of meshes
        and splats refuse. Names object and frame.
    WriteError
        Naming the file and the system's reason.
    """
    check_usd(str(path))
    suffix = path.suffix.lower()
    notes: list[str] = []
    folder = "textures" if suffix == ".usdz" else f"{path.stem.replace('@', '_')}_textures"

    def save(temporary: Path) -> None:
        crate = temporary if suffix in (".usdc", ".usd") else temporary.with_name("asset.usdc")
        objects = _write_crate(crate, path, frames, fps, (kernel, materials, f"{folder}/"))
        pictures = {name: data for made in objects for name, data in made.pictures.items()}
        notes.extend(note for made in objects for note in made.notes)
        if suffix == ".usdz":
            if crate.stat().st_size + sum(map(len, pictures.values())) > _LARGEST_PACKAGE:
                problem = "would be larger than 4 GB, which USDZ cannot be"
                raise UsageError(str(path), problem, "Write .usdc, or fewer frames")
            write_package(
                temporary, {crate.name: crate.read_bytes()} | {f"{folder}/{n}": d for n, d in pictures.items()}
            )
            return
        if suffix == ".usda":
            _as_text(crate, temporary)
        if pictures:
            _write_pictures(path.with_name(folder), pictures)

    replace_by(path, save)
    return notes


def _write_crate(
    crate: Path,
    path: Path,
    frames: Iterable[tuple[int, list[MovingObject]]],
    fps: float,
    options: tuple[str, bool, str],
) -> list[_Object]:
    """Write the stage of `path` as a crate, which is closed then; what it has."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(crate))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().documentation = f"DR-GS {__version__}"
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/root").GetPrim())
    objects: dict[str, _Object] = {}
    numbers: list[int] = []
    held = 0
    for number, moving in frames:
        for state in moving:
            if state.name not in objects:
                objects[state.name] = _Object(stage, _prim_name(stage, state.name), state, *options, str(path))
                if numbers:
                    objects[state.name].hide(numbers[0], numbers[-1])
            objects[state.name].add(number, state)
            held += (0 if state.mesh is None else len(state.mesh.vertices)) + len(state.splats or ())
        for name in objects.keys() - {state.name for state in moving}:
            objects[name].hide(number, number)
        numbers.append(number)
        if held > _HELD:
            stage.Save()
            held = 0
    if not objects:
        raise UsageError(str(path), "would hold no object", "Choose frames in which there is one")
    for made in objects.values():
        made.finish()
    stage.SetStartTimeCode(numbers[0])
    stage.SetEndTimeCode(numbers[-1])
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.Save()
    return list(objects.values())


def _as_text(crate: Path, path: Path) -> None:
    """Write a stage as USDA."""
    from pxr import Sdf

    Sdf.Layer.FindOrOpen(str(crate)).Export(str(path))


def _write_pictures(folder: Path, pictures: dict[str, bytes]) -> None:
    """Files by name. Raises WriteError."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        reason = f"is the folder of the images, which cannot be made ({error.strerror})"
        raise WriteError(str(folder), reason, "Move what has that name, or write a .usdz") from error
    for name, data in pictures.items():
        replace_file(folder / name, [data])


class _Object:
    """The prims of one object and what has been written to them."""

    def __init__(
        self, stage: Any, name: str, state: MovingObject, kernel: str, materials: bool, folder: str, subject: str
    ) -> None:
        from pxr import UsdGeom

        self._subject, self._name, self._materials = subject, state.name, materials
        self._samples: dict[Any, Samples] = {}
        self._rotation: Array | None = None
        self._first: MovingObject = state
        self._span: tuple[int, ...] = ()  # the first and the last frame of its mesh
        self.pictures: dict[str, bytes] = {}
        self.notes: list[str] = []
        self._xform = UsdGeom.Xform.Define(stage, f"/root/{name}")
        self._transform = self._xform.AddTransformOp()
        self._mesh = self._points = self._field = None
        self._smooth: VertexNormals | None = None
        if state.mesh is not None:
            self._mesh = UsdGeom.Mesh.Define(stage, f"/root/{name}/{name}")
            self._define_mesh(stage, name, state.mesh, folder)
        if state.points is not None:
            particles = _prim_name(stage, "particles", f"/root/{name}")
            self._points = UsdGeom.Points.Define(stage, f"/root/{name}/{particles}")
        if state.splats is not None:
            self._field = define_field(stage, f"/root/{name}_surfels", kernel)

    def _define_mesh(self, stage: Any, name: str, mesh: Mesh, folder: str) -> None:
        """Topology, texture coordinates and materials, which do not move."""
        from pxr import Sdf, UsdGeom, UsdShade, Vt

        groups = face_groups(mesh, f'object "{self._name}"')
        prim = self._mesh
        assert prim is not None
        prim.CreateDoubleSidedAttr(True)
        prim.CreateSubdivisionSchemeAttr("none")
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).reshape(-1)))
        if any(group.uvs is not None for group in groups):
            uvs = np.zeros((len(mesh.faces), 3, 2), np.float32)
            for group in groups:
                uvs[group.faces] = 0 if group.uvs is None else group.uvs * [1, -1] + [0, 1]  # v points up in USD
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            coordinates = UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
            coordinates.Set(Vt.Vec2fArray.FromNumpy(uvs.reshape(-1, 2)))
        names = ["Material"] if len(groups) == 1 else [f"Material{k}" for k in range(len(groups))]
        names = [_prim_name(stage, own, f"/root/{name}") for own in names]
        folders = f"./{folder}{name}_"
        texts = [material_text(n, g.material, f"/root/{name}", folders) for n, g in zip(names, groups, strict=True)]
        whole = "\n".join(["#usda 1.0", 'def "root"', "{", f'def "{name}"', "{", *texts, "}", "}"])
        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.ImportFromString(whole)
        for own, group in zip(names, groups, strict=True):
            path = f"/root/{name}/{own}"
            Sdf.CopySpec(layer, path, stage.GetRootLayer(), path)
            bound = prim.GetPrim()
            if len(groups) > 1:
                faces = Vt.IntArray.FromNumpy(np.ascontiguousarray(group.faces, np.int32))
                bound = UsdGeom.Subset.CreateGeomSubset(prim, own, "face", faces, "materialBind", "partition").GetPrim()
            UsdShade.MaterialBindingAPI.Apply(bound).Bind(UsdShade.Material.Get(stage, path))
            self.pictures |= {f"{name}_{file}": data for file, data in picture_files(group)}

    def add(self, number: int, state: MovingObject) -> None:
        """The object in a frame."""
        from pxr import Gf, UsdGeom

        # USD's matrices take rows for vectors.
        self._set(number, self._transform.GetAttr(), Gf.Matrix4d(np.asarray(state.matrix_world, np.float64).T.tolist()))
        self._set(number, self._xform.CreateVisibilityAttr(), UsdGeom.Tokens.inherited)
        for kind in ("mesh", "points", "splats"):
            if (getattr(state, kind) is None) != (getattr(self._first, kind) is None):
                self._refuse(number, f"{kind} in some frames only")
        if state.mesh is not None:
            self._add_mesh(number, state.mesh, state.normals)
        if state.points is not None:
            assert self._points is not None
            self._set(number, self._points.GetPointsAttr(), _vectors(state.points))
            self._set(number, self._points.GetExtentAttr(), _extent(state.points))
        if state.splats is not None:
            self._add_splats(number, state.splats)

    def _add_mesh(self, number: int, mesh: Mesh, normals: Array | None) -> None:
        from pxr import Sdf, UsdGeom, Vt

        prim, first = self._mesh, self._first.mesh
        assert prim is not None and first is not None
        if not np.array_equal(mesh.faces, first.faces) or len(mesh.vertices) != len(first.vertices):
            self._refuse(number, "other faces")
        if bad := int((~np.isfinite(mesh.vertices)).any(axis=1).sum()):
            problem = f"has {bad} vertices that are NaN or infinite in frame {number}"
            raise AssetError(f'object "{self._name}"', problem, "Correct its pose, or leave this frame out")
        self._set(number, prim.GetPointsAttr(), _vectors(mesh.vertices))
        self._set(number, prim.GetExtentAttr(), _extent(mesh.vertices))
        if normals is None and mesh.textures is not None and mesh.textures.normals is not None:
            normals = corner_normals(mesh)
        attribute = prim.GetNormalsAttr()
        if normals is None:
            if self._smooth is None:
                self._smooth = VertexNormals(mesh.faces, len(mesh.vertices))
            own, kind = self._smooth(mesh.vertices), UsdGeom.Tokens.vertex
        else:
            own, kind = normals.reshape(-1, 3), UsdGeom.Tokens.faceVarying
        if attribute not in self._samples:
            prim.SetNormalsInterpolation(kind)
        elif kind != prim.GetNormalsInterpolation():
            self._refuse(number, "another kind of shading (smooth or not)")
        self._set(number, attribute, _vectors(own))
        primvars = UsdGeom.PrimvarsAPI(prim)
        for channel in _CHANNELS:
            if getattr(mesh, channel) is None and not primvars.HasPrimvar(channel):
                continue
            values = mesh.channel(channel)
            coloured = values.ndim == 2
            kinds = Sdf.ValueTypeNames.Color3fArray if coloured else Sdf.ValueTypeNames.FloatArray
            write = _vectors if coloured else lambda v: Vt.FloatArray.FromNumpy(np.ascontiguousarray(v, np.float32))
            attribute = primvars.CreatePrimvar(channel, kinds, UsdGeom.Tokens.vertex).GetAttr()
            if attribute not in self._samples:  # it was neutral, if there was a frame before
                for before in dict.fromkeys(self._span):
                    self._set(before, attribute, write(neutral_values(channel, len(mesh.vertices))))
            if self._set(number, attribute, write(values)) and not self.notes:
                text = f"its material changes in frame {number}: its images stay those of its first one"
                self.notes.append(f"{self._name}: {text}")
        self._span = (*self._span[:1], number)

    def _add_splats(self, number: int, splats: Splats) -> None:
        """Rotations keep their sign from frame to frame, so that programs find the shorter way between two."""
        splats = writable(splats, f'object "{self._name}", frame {number}')
        if self._rotation is not None:
            if len(self._rotation) != len(splats):
                self._refuse(number, "another number of surfels")
            turned = np.einsum("nk,nk->n", self._rotation, splats.rotation) < 0
            splats = replace(splats, rotation=np.where(turned[:, None], -splats.rotation, splats.rotation))
        self._rotation = splats.rotation
        for attribute, value in field_values(self._field, splats, self._materials):
            self._set(number, attribute, value)
        from pxr import UsdGeom

        self._set(number, UsdGeom.Imageable(self._field).CreateVisibilityAttr(), UsdGeom.Tokens.inherited)

    def hide(self, first: int, last: int) -> None:
        """The object is not there in these frames."""
        from pxr import UsdGeom

        for prim in (self._xform, self._field):
            if prim is not None:
                attribute = UsdGeom.Imageable(prim).CreateVisibilityAttr()
                for number in dict.fromkeys((first, last)):
                    self._set(number, attribute, UsdGeom.Tokens.invisible)

    def finish(self) -> None:
        """Write what never changed."""
        for samples in self._samples.values():
            samples.finish()

    def _set(self, number: int, attribute: Any, value: Any) -> bool:
        """Give an attribute its value; whether that differs from the one before."""
        samples = self._samples.setdefault(attribute, Samples(attribute))
        return samples.add(number, value)

    def _refuse(self, number: int, what: str) -> None:
        problem = f'object "{self._name}" has {what} in frame {number}, which one file cannot hold'
        raise UsageError(
            self._subject, problem, "Write a file for each frame: name it with ####, or choose other frames"
        )


def _vectors(values: Array) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def _extent(values: Array) -> Any:
    return _vectors(np.stack([values.min(axis=0), values.max(axis=0)]) if len(values) else np.zeros((2, 3)))


def _prim_name(stage: Any, name: str, parent: str = "/root") -> str:
    """A name that USD takes, below `parent` and of no prim yet, as Blender makes it of an object's."""
    from pxr import Tf

    plain = Tf.MakeValidIdentifier(name)
    found, count = plain, 0
    while stage.GetPrimAtPath(f"{parent}/{found}") or stage.GetPrimAtPath(f"{parent}/{found}_surfels"):
        count += 1
        found = f"{plain}_{count:03d}"
    return found
