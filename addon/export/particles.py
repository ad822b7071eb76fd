"""Particles of a simulation that carry an object's splats in this frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import bpy
import numpy as np

from ...drgs_blender.core.errors import AssetError, DrgsError
from ...drgs_blender.core.frame import Particles
from ...drgs_blender.core.particle_cache import Header, ParticleCache, ParticleFrame
from .. import cache_playback

Array = np.ndarray
Warn = Callable[[str], None]

#: How far vertices may be from where the simulation has them, in parts of the object's size.
_CLOSE = 1e-4
#: Vertices by which a map is found; all are looked at to see whether it fits.
_PROBES = 4096
#: A mesh is flat where it is thinner than this part of its size.
_FLAT = 1e-6
#: What is at rest by folder, digest and version of its cache, and how many caches are known at most.
_rests: dict[tuple[str, str, int], ParticleFrame] = {}
_MOST = 16


def particles_of(
    obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, vertices: Array, rest: Array, warn: Warn
) -> Particles | None:
    """What carries the splats of an evaluated object besides the faces of its mesh, or says only what has broken.

    None: faces alone carry splats, and nothing that breaks is closed.

    Parameters
    ----------
    obj : bpy.types.Object
    depsgraph : bpy.types.Depsgraph
    vertices : (n, 3) float32 array
        Of its evaluated mesh, in the mesh's order, object space.
    rest : (n, 3) float array
        Where they are when the surfels are as in the asset; not finite where that is not known.
    warn : callable
        Told why particles that were asked for, or are there, carry nothing.
    """
    physics, modifier = obj.drgs.physics, cache_playback.modifier_of(obj)
    wanted, closes, hollow = physics.driven_by, physics.tear, physics.inside == "open"
    if (wanted == "surface" and not closes and physics.surface == "mesh") or modifier is None or not len(vertices):
        return None
    follow = "splats follow the mesh" if wanted != "surface" else "what it tears apart is hollow"
    if closes and not hollow and wanted != "surface":
        follow += ", and what is torn is hollow"
    ends = "Driven By: Surface and Inside: Hollow say so"
    if not (modifier.show_render if depsgraph.mode == "RENDER" else modifier.show_viewport):
        return None
    path = cache_playback.path_of(obj, modifier)
    cache = ParticleCache(path.parent)
    try:
        header = cache.header()
        if header is None:
            return None  # told by `cache_playback.check`
        skin = header.has_skin(physics.surface, obj.drgs.captured_colours)
        if skin and header.cells is None:
            warn(f'"{obj.name}": was baked before particles had a surface, so its mesh is shown, stretched. Bake again')
            skin = False
        closes = closes and header.keeps_shape and not skin
        follow, ends = ("its mesh is shown, stretched", "Surface: Mesh says so") if skin else (follow, ends)
        if wanted == "surface" and not (closes or skin):
            return None
        if not header.keeps_shape and not skin:
            if wanted == "particles":
                warn(f'"{obj.name}": its material flows, so no particle knows how it deforms; splats follow the mesh')
            return None
        if closes and header.cells is None:
            if not hollow:
                warn(f'"{obj.name}": was baked before pieces were closed, so what is torn is hollow. Bake again')
            if wanted == "surface":
                return None
        played = cache_playback.Played(path, header)
        frame = _frame_of(modifier, header, depsgraph.scene_eval)
        still = _rest_of(cache, header)
        if closes and header.cells is not None and still.broken is None:
            warn(
                f'"{obj.name}": was baked before frames knew what had broken until then, so cracks may close again. '
                "Bake again"
            )
        particles, shown = cache.driving(frame, still, last=played.last, place=_placing(played))
    except (DrgsError, OSError) as error:
        warn(f'"{obj.name}": {follow}, as particles cannot be read: {error}')
        return None
    began = still.vertices
    posed = not skin and not _same_places(began, rest)
    if posed and wanted == "particles":
        warn(
            f'"{obj.name}": its simulation begins with another shape than the captured one (posed, or edited), '
            "so splats follow the mesh; Driven By: Surface says so for good"
        )
    if posed and (not closes or began.shape != vertices.shape):
        return None
    moved = _moved(particles, _affine(shown, vertices))
    if moved is None and hollow and wanted == "surface" and not skin:
        return None  # as it was asked for
    if moved is None:
        warn(
            f'"{obj.name}": its mesh is not as the simulation has it in this frame (modifiers after '
            f'"{modifier.name}", or edits), so {follow}; {ends} for good'
        )
        return None
    cells = np.array(header.cells, np.float64) if header.cells is not None and (closes or skin) else None
    carries = wanted != "surface" and header.keeps_shape and not posed
    mesh = began if posed else None
    return replace(moved, all=wanted == "particles", cells=cells, surfels=carries, skin=skin, began=mesh)


def _frame_of(modifier: bpy.types.Modifier, header: Header, scene: bpy.types.Scene) -> float:
    """The frame of the cache that a Mesh Cache modifier shows, as Blender's MOD_meshcache.cc finds it."""
    if modifier.play_mode == "CUSTOM":
        index = modifier.eval_frame
    else:
        index = scene.frame_current_final * modifier.frame_scale - modifier.frame_start
    return header.first + (round(index) if modifier.interpolation == "NONE" else index)


def _same_places(a: Array, b: Array) -> bool:
    """Whether vertices are where others are, as far as these are known."""
    known = np.isfinite(b).all(axis=1)
    if a.shape != b.shape or not known.any():
        return False
    return bool(np.abs(a[known] - b[known]).max() <= _CLOSE * float(np.ptp(b[known], axis=0).max()))


def _rest_of(cache: ParticleCache, header: Header) -> ParticleFrame:
    """Particles and vertices of a cache at rest, read once."""
    key = str(cache.folder), header.digest, header.version
    if key in _rests:
        return _rests[key]
    read = cache.rest()
    broken = None if read.broken is None else np.array(read.broken)
    rest = ParticleFrame(np.array(read.points), np.array(read.gradients), np.array(read.vertices), broken)
    now = cache.header()
    if now is None or (now.digest, now.version) != (header.digest, header.version):
        raise AssetError(str(cache.folder), "is being baked again", "Wait for the first frames")
    if len(_rests) >= _MOST:
        _rests.clear()
    _rests[key] = rest
    return rest


def _placing(played: cache_playback.Played) -> Callable[[int, ParticleFrame], ParticleFrame]:
    """Brings a frame into the object space in which it is played: that of an object that moves by itself turns."""

    def place(number: int, frame: ParticleFrame) -> ParticleFrame:
        vertices = played.vertices(number)
        if np.array_equal(vertices, frame.vertices):
            return frame
        particles = Particles(frame.points, frame.points, frame.gradients)
        moved = _moved(particles, _affine(frame.vertices, vertices))
        if moved is None:
            raise AssetError(str(played.path), f"does not hold frame {number} of its cache", "Bake again")
        return replace(frame, points=moved.points, gradients=moved.gradients, vertices=vertices)

    return place


def _moved(particles: Particles, affine: tuple[Array, Array] | None) -> Particles | None:
    """Particles by an affine map; None without one."""
    if affine is None:
        return None
    linear, offset = (part.astype(np.float32) for part in affine)
    if np.array_equal(linear, np.eye(3)) and not offset.any():
        return particles
    rows = linear @ particles.gradients.transpose(1, 0, 2).reshape(3, -1)
    gradients = np.ascontiguousarray(rows.reshape(3, -1, 3).transpose(1, 0, 2))
    return replace(particles, points=particles.points @ linear.T + offset, gradients=gradients)


def _affine(before: Array, after: Array) -> tuple[Array, Array] | None:
    """The affine map, (3, 3) and (3,), that takes (n, 3) places to others; None where no such map does.

    Of a flat mesh the side that is out stays out, at its distance; of a line nothing says how it has turned.
    """
    if before.shape != after.shape or not (np.isfinite(before).all() and np.isfinite(after).all()):
        return None
    size = float(np.ptp(before, axis=0).max())
    if np.abs(after - before).max() <= _CLOSE * size:
        return np.eye(3), np.zeros(3)
    some = slice(None, None, max(len(before) // _PROBES, 1))
    a, b = before[some].astype(np.float64), after[some].astype(np.float64)
    middle, there = a.mean(axis=0), b.mean(axis=0)
    _, extents, axes = np.linalg.svd(a - middle, full_matrices=False)
    if len(extents) < 3 or extents[1] <= _FLAT * extents[0]:
        return None
    linear = np.linalg.lstsq(a - middle, b - there, rcond=_FLAT)[0].T
    if extents[2] <= _FLAT * extents[0]:
        normal = np.cross(linear @ axes[0], linear @ axes[1]) * np.linalg.det(axes)
        length = float(np.linalg.norm(normal))
        if length == 0.0:
            return None
        linear = linear + np.outer(normal / length - linear @ axes[2], axes[2])
    offset = there - linear @ middle
    fits = before @ linear.T.astype(np.float32) + offset.astype(np.float32)
    return (linear, offset) if np.abs(fits - after).max() <= _CLOSE * size else None
