"""What is told about the scene of a frame, in words for the user."""

from __future__ import annotations

from collections.abc import Collection

from ..core.passes import COLOURS
from ..render.scene.see_through import MOST
from .scene_cache import SceneCache

#: Passes that are black without light.
_LIT = frozenset({"Combined", *COLOURS})


def scene_warnings(cache: SceneCache, passes: Collection[str] = ()) -> list[str]:
    """Warnings about meshes and light of the last frame, of which `passes` were made."""
    found = []
    if not cache.objects and not cache.meshes:
        found.append("the frame has no DR-GS object; the picture shows the world alone")
    # Of a skin, which is made anew in every frame, nothing can be mended. Behind these are those that glow, once more.
    known = [(item.hidden_count, item.skin is not None) for item in cache.objects] + [(0, False)] * len(cache.meshes)
    for (hidden, skin), fault in zip(known, cache.scene.faults):
        if fault.bad_vertices:
            surfels = f" and {hidden} surfels" if hidden else ""
            found.append(
                f"{fault.name}: {fault.bad_vertices} vertices are not finite or too far away; "
                f"{fault.bad_faces} faces{surfels} are left out"
            )
        if fault.empty_faces and not skin:
            found.append(f"{fault.name}: {fault.empty_faces} faces have no area; light passes through them")
        if fault.bad_instances:
            found.append(
                f"{fault.name}: {fault.bad_instances} instances are flat, not finite or too far away; left out"
            )
    for name in dict.fromkeys(_name(cache, index) for index in sorted(cache.scene.cut)):
        found.append(
            f"{name}: rays pass {MOST} see-through surfaces up to it, and end there; what is behind is not seen. "
            "Use fewer layers"
        )
    for item in cache.objects:
        found += item.faults
        moving = [name for name in ("Vector", "Previous Position") if name in passes]
        if (item.cracks or item.skin is not None) and moving:
            what = "the faces at its cracks" if item.skin is None else "the surface of its particles"
            found.append(f"{item.state.name}: {what} count as still in {' and '.join(moving)}")
        if item.lost:
            found.append(
                f"{item.state.name}: {item.lost} surfels are left out: particles that carry them are not finite. "
                "Bake again"
            )
    found += cache.captured_faults
    found += cache.scene.mesh_materials.warnings
    found += cache.lights.warnings
    if not _LIT.isdisjoint(passes) and _is_unlit(cache):
        found.append(
            "nothing lights the scene: it has no lamp that shines, its World gives no light and no material emits "
            "any. Add a lamp, or give the World a colour or an environment image that is not black"
        )
    worlds = [light for light in (cache.environment, cache.background) if light is not None]
    if any(light.negative_colour for light in worlds):
        found.append("world: a part of its colour is negative, and counts as 0. Choose a colour of 0 or more")
    bad = sum(light.bad_texels for light in worlds)
    if bad:
        found.append(
            f"world: {bad} pixels of the environment are negative, infinite or no number, and "
            "give no light; where that shows, repair the image"
        )
    return found


def _is_unlit(cache: SceneCache) -> bool:
    """Whether the camera sees something to which nothing gives light."""
    assert cache.environment is not None
    lit = not cache.environment.black or cache.lights.count or cache.scene.emissive_meshes
    if lit or cache.captured or cache.emission is not None:
        return False
    seen = [*(item.state.visibility for item in cache.objects), *(mesh.visibility for mesh in cache.meshes)]
    return any(own.camera and not own.holdout for own in seen)


def _name(cache: SceneCache, index: int) -> str:
    """Of an object as the trace scene numbers them."""
    return cache.scene.faults[int(cache.scene.source[index])].name
