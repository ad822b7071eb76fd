"""DR-GS objects of an evaluated scene -> frame.ObjectState, one for each visible instance."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import bpy
import numpy as np

from ...drgs_blender.core.asset import MATERIAL_CHANNELS, Asset
from ...drgs_blender.core.asset.part import Part, has_surfels, part_of, whole_of
from ...drgs_blender.core.frame import Adjustment, ObjectState, ProxyMesh
from ...drgs_blender.core.materials import Image, ShaderAOV
from ...drgs_blender.core.passes import Pass
from .. import assets, cache_playback, carrier_nodes, mesh_arrays, point_caches, proxies, surfel_points
from ..viewport_material import is_viewport_material
from .aov_nodes import aov_values
from .export_cache import PAINTED, ExportCache, uid
from .holdouts import Holdouts
from .instances import Key, Visible, terminator_offset
from .materials import finite
from .meshes import check_normals
from .painted_images import painted_images, read_picture
from .particles import particles_of
from .surface_nodes import SurfaceWalker
from .topology_check import Fit, check_modifiers, check_topology

Warn = Callable[[str], None]
#: Gives the engine's key of the asset at a path.
KeyOf = Callable[[Path], str]


class Appearance(NamedTuple):
    """What an object has of its asset, and how that differs.

    Attributes
    ----------
    asset : Asset
        Of what is left of it.
    vertices : (n, 3) float32 array
        Object space, evaluated.
    painted : dict of str to array
        Channels of the vertices that differ from the asset's.
    adjustment : Adjustment, optional
    proxy : ProxyMesh, optional
        What moves its surfels, where it has no mesh.
    """

    asset: Asset
    vertices: np.ndarray
    painted: dict[str, np.ndarray]
    adjustment: Adjustment | None
    proxy: ProxyMesh | None = None


class DrgsObjects:
    """Collects the DR-GS objects of one export."""

    def __init__(
        self,
        depsgraph: bpy.types.Depsgraph,
        key_of: KeyOf,
        warn: Warn,
        cache: ExportCache,
        aovs: Sequence[Pass] = (),
    ) -> None:
        self._depsgraph, self._key_of, self._warn, self._cache, self._aovs = depsgraph, key_of, warn, cache, aovs
        self._holdouts, self._separated = Holdouts(warn), proxies.Separated(warn)
        self.states: list[ObjectState] = []
        self.keys: list[Key] = []

    def add(self, item: Visible) -> None:
        """Take in a visible instance.

        Raises
        ------
        AssetError
            Its asset or what it plays is missing, or the evaluated mesh is not the asset's; names object and modifiers.
        """
        obj = item.object
        if not np.isfinite(item.matrix_world).all():
            self._warn(f'"{obj.name}": its transform is not finite; it is left out. Check its drivers and constraints')
            return
        if obj.original.data.attributes.get(proxies.REST) is None:
            check_modifiers(obj, self._depsgraph)
        elif obj.mode != "EDIT" and obj.original.drgs.surfel_points is None:
            self._separated.add(obj)
        carrier_nodes.check(obj, self._depsgraph, self._warn)
        cache_playback.check(obj, self._warn, final=self._depsgraph.mode == "RENDER")
        appearance = (
            obj.drgs.show_captured, obj.drgs.adjustment.values(), str(cache_playback.fracture_state(obj)),
            obj.drgs.physics.driven_by, obj.drgs.physics.surface, surfel_points.state_of(obj),
        )  # fmt: skip
        shape = self._cache.get(
            ("object", uid(obj), obj.name, obj.data.as_pointer(), obj.mode, str(assets.file_of(obj)), appearance),
            (uid(obj), uid(obj.data), uid(obj.original.drgs.surfel_points)),
            lambda: _shape(obj, self._depsgraph, self._key_of, self._warn),
        )
        if (lack := _lack(obj, shape.part, self._depsgraph.scene.drgs)) is not None:
            self._warn(f'"{obj.name}": {lack}; it is left out')
            return
        material = obj.material_slots[0].material if obj.material_slots else None
        painted = [] if obj.drgs.show_captured else self._painted(obj)
        visibility = self._holdouts.cut_out(item, [material], lambda: None).visibility
        self.states.append(
            replace(
                shape,
                matrix_world=item.matrix_world,
                pass_index=obj.pass_index,
                material_pass_index=0 if material is None else material.pass_index,
                visibility=visibility,
                images=painted,
                captured_colours=obj.drgs.captured_colours,
                light_group=obj.lightgroup,
                terminator_offset=terminator_offset(obj, self._warn),
                aovs=_aovs(material, obj, self._aovs, self._warn) if material is not None and self._aovs else [],
            )
        )
        _check_shown(obj, material, shape, self._warn)
        self.keys.append(item.key)

    def _painted(self, obj: bpy.types.Object) -> list[Image]:
        """Images of its asset that are painted over."""
        path = assets.file_of(obj)
        said: list[str] = []
        found, told = self._cache.get(
            (PAINTED, uid(obj), str(path)),
            (uid(obj), uid(obj.data)),
            lambda: (painted_images(obj, assets.load(path), said.append, self._picture), said),
        )
        for text in told:
            self._warn(text)
        return found

    def _picture(self, image: bpy.types.Image, warn: Warn) -> Image | None:
        """Pixels of an image, read once for all objects that show it, and so sent once."""
        said: list[str] = []
        found, told = self._cache.get(
            (PAINTED, uid(image)), (uid(image),), lambda: (read_picture(image, said.append), said)
        )
        for text in told:
            warn(text)
        return found


def _lack(obj: bpy.types.Object, part: Part | None, settings: bpy.types.PropertyGroup) -> str | None:
    """Why nothing would be seen of what an object has left of its asset; None: something is."""
    if part is None:
        return None
    asset = assets.load(assets.file_of(obj))
    if asset.binding is not None and not len(part.face):
        return "none of the faces of its asset is left"
    if "surfels" in (settings.camera_sees, settings.rays_see) and not has_surfels(asset, part):
        return "none of the surfels of its asset is left"
    return None


def _check_shown(obj: bpy.types.Object, material: bpy.types.Material | None, shape: ObjectState, warn: Warn) -> None:
    """Name the channels that are rendered here, and that the material for Blender's own engines has no node for."""
    if material is None or material.node_tree is None or not is_viewport_material(material):
        return
    shown = {node.attribute_name for node in material.node_tree.nodes if node.type == "ATTRIBUTE"}
    for channel in ("opacity", "emission"):
        if getattr(shape, channel) is not None and channel not in shown:
            warn(
                f'"{obj.name}": its attribute {channel} is not seen in Cycles and the viewport: the material '
                f'"{material.name}" has no node for it. Paint > {channel.title()} adds one'
            )


def _aovs(material: bpy.types.Material, obj: bpy.types.Object, aovs: Sequence[Pass], warn: Warn) -> list[ShaderAOV]:
    """What an object gives to shader AOVs; on surfels that is the same everywhere."""
    tree = SurfaceWalker(material, obj.data, warn)
    values = {name: tree.flat(ref.node, value) for name, (ref, value) in aov_values(tree, aovs).items()}
    return [ShaderAOV(name, finite(tree, name, colour)) for name, colour in values.items()]


def _shape(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, key_of: KeyOf, warn: Warn) -> ObjectState:
    """What all instances of an object share."""
    path = assets.file_of(obj)
    asset = assets.load(path)
    captured = obj.drgs.show_captured
    with _readable(obj, depsgraph) as mesh:
        if proxies.is_proxy(mesh, asset):
            fit = _without_removed(Fit(), obj, asset, depsgraph)
            state = ObjectState(obj.name, key_of(path), part=fit.part, proxy=proxies.read(mesh))
            state.adjustment = None if captured else _adjustment(obj, mesh, None, warn)
            given = mesh_arrays.read_vertices(mesh), proxies.read_rest(mesh)
            proxies.check(obj, given[1], warn, final=depsgraph.mode == "RENDER")
            particles = None if state.proxy is None else particles_of(obj, depsgraph, *given, warn)
            if particles is not None and particles.surfels:
                state.proxy, state.particles = None, replace(particles, all=True)
            return state
        point_caches.check(obj, asset.mesh, warn, final=depsgraph.mode == "RENDER")
        fit = _without_removed(check_topology(obj, mesh, asset.mesh, warn), obj, asset, depsgraph)
        vertices = mesh_arrays.read_vertices(mesh)
        arrays: dict[str, Any] = {
            "vertices": fit.of_part(vertices),
            "corner_normals": _corner_normals(obj, mesh, fit, warn),
            **{c: None if captured else _edited(obj, mesh, asset, c, fit, warn) for c in MATERIAL_CHANNELS},
        }
        for array in arrays.values():
            if array is not None:
                array.flags.writeable = False  # so that the engine's client need not copy it
        appearance = cache_playback.fracture_state(obj)
        particles = particles_of(obj, depsgraph, vertices, fit.rest(asset.mesh, len(vertices)), warn)
        if particles is not None and particles.began is not None:
            particles = replace(particles, began=fit.of_part(particles.began))
        appearance["particles"] = particles
        adjustment = None if captured else _adjustment(obj, mesh, fit, warn)
        return ObjectState(
            name=obj.name, asset=key_of(path), part=fit.part, adjustment=adjustment, **arrays, **appearance
        )


@contextlib.contextmanager
def _readable(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None) -> Iterator[bpy.types.Mesh]:
    """The mesh of an evaluated object; in Edit Mode, where that is a wrapper without arrays, a converted copy.

    In viewports it is as it is edited now, with the modifiers that are shown there.
    """
    if obj.mode != "EDIT":
        yield obj.data
        return
    try:
        if depsgraph is None or depsgraph.mode == "VIEWPORT":
            yield obj.to_mesh()
        else:  # of what Blender has written back before
            yield obj.to_mesh(preserve_all_data_layers=True, depsgraph=depsgraph)
    finally:
        obj.to_mesh_clear()


def _without_removed(fit: Fit, obj: bpy.types.Object, asset: Asset, depsgraph: bpy.types.Depsgraph | None) -> Fit:
    """How an object fits its asset, without the surfels that were removed from it."""
    removed = surfel_points.removed_of(obj, asset, depsgraph)
    if removed is None:
        return fit
    part = whole_of(asset.mesh) if fit.part is None else fit.part
    return fit._replace(part=replace(part, removed=removed))


def appearance_of(
    obj: bpy.types.Object, asset: Asset, warn: Warn, depsgraph: bpy.types.Depsgraph | None = None
) -> Appearance:
    """What an evaluated object has of its asset, and how that differs.

    With the `depsgraph` of a viewport, meshes and points in Edit Mode count as they are now.

    Raises
    ------
    AssetError
        Its mesh is not the asset's any more; names the object.
    """
    with _readable(obj, depsgraph) as mesh:
        if proxies.is_proxy(mesh, asset):
            part = _without_removed(Fit(), obj, asset, depsgraph).part
            own = asset if part is None else part_of(asset, part, f'Object "{obj.name}"')
            return Appearance(own, asset.mesh.vertices, {}, _adjustment(obj, mesh, None, warn), proxies.read(mesh))
        fit = _without_removed(check_topology(obj, mesh, asset.mesh, warn), obj, asset, depsgraph)
        painted = {channel: _edited(obj, mesh, asset, channel, fit, warn) for channel in MATERIAL_CHANNELS}
        return Appearance(
            asset if fit.part is None else part_of(asset, fit.part, f'Object "{obj.name}"'),
            fit.of_part(mesh_arrays.read_vertices(mesh)),
            {name: values for name, values in painted.items() if values is not None},
            _adjustment(obj, mesh, fit, warn),
        )


def _corner_normals(obj: bpy.types.Object, mesh: bpy.types.Mesh, fit: Fit, warn: Warn) -> np.ndarray | None:
    """Normals per corner where the mesh has flat, sharp or custom ones; smooth ones the engine makes itself."""
    if mesh.normals_domain == "POINT":
        return None
    normals = mesh_arrays.read_corner_normals(mesh)
    normals = normals.reshape(-1, 3, 3) if fit.corners is None else normals[fit.corners]
    check_normals(obj.name, mesh, normals, warn)
    return normals


def _adjustment(obj: bpy.types.Object, mesh: bpy.types.Mesh, fit: Fit | None, warn: Warn) -> Adjustment | None:
    """The adjustments of an object; None where they change nothing, or are masked on a proxy, which `fit`s nothing."""
    settings = obj.drgs.adjustment
    if not settings.values():
        return None
    if settings.mask and fit is None:
        warn(f'"{obj.name}": its adjustments want the mask "{settings.mask}" of a proxy, not of surfels; they are not '
             "applied. Clear the mask")  # fmt: skip
        return None
    mask = None
    if fit is not None and settings.mask:
        mask = mesh_arrays.read_mask(obj, mesh, settings.mask)
        if mask is None:
            warn(
                f'"{obj.name}": its adjustments want the mask "{settings.mask}", which is no vertex group or number of '
                "points; they are applied nowhere"
            )
            return None
        mask = fit.of_part(mask)
        if lost := int((~np.isfinite(mask)).sum()):
            warn(f'"{obj.name}": {lost} values of the mask "{settings.mask}" are not finite; 0 is used there')
            mask = np.nan_to_num(mask, posinf=0.0, neginf=0.0)
    return settings.to_frame(mask, warn)


def _edited(
    obj: bpy.types.Object, mesh: bpy.types.Mesh, asset: Asset, channel: str, fit: Fit, warn: Warn
) -> np.ndarray | None:
    """A material channel where it differs from the asset's, else None."""
    try:
        values = mesh_arrays.read_channel(mesh, channel)
    except TypeError as error:
        warn(f'"{obj.name}": attribute {channel} is {error}; the asset\'s values are used')
        return None
    if values is None:
        return None
    values, own = fit.of_part(values), fit.of_asset(asset.mesh.channel(channel))
    lost = np.isnan(values)
    if lost.any():
        warn(f'"{obj.name}": {lost.sum()} values of attribute {channel} are not finite; the asset\'s are used there')
        values[lost] = own[lost]
    return None if np.array_equal(values, own) else values
