"""Which kernels a frame needs."""

from __future__ import annotations

from ..core.frame import Frame, Light, MeshState
from ..core.passes import AOVS, COLOURS
from ..render.film.surface_film import CHANNELS
from ..render.lights.light_groups import groups_of
from .broken_matter import can_break


def jobs_of(frame: Frame) -> list[str]:
    """Jobs of `compute.manifest` whose kernels a frame needs, in the order of the stages."""
    settings, jobs = frame.settings, ["frame"]
    if settings.camera_sees == "mesh" or not any(state.visibility.camera for state in frame.objects):
        jobs.append("mesh")
    if any(state.captured_colours for state in frame.objects):
        jobs += ["captured", "lights"]
    if settings.rays_see == "surfels" or (frame.camera.panorama and settings.camera_sees == "surfels"):
        jobs.append("surfel rays")
    seen = [state.visibility for state in frame.objects] + [state.visibility for state in frame.meshes]
    catchers = any(visibility.shadow_catcher for visibility in seen)
    if settings.denoise == "svgf" or (settings.denoise != "none" and catchers):
        jobs.append("denoise")
    if frame.lights or frame.meshes:
        jobs.append("lights")
    if frame.previous is not None or frame.next is not None:
        jobs.append("motion")
    if any(can_break(state) for state in frame.objects):
        jobs.append("broken")
    if any(name.startswith("Crypto") for name in frame.passes):
        jobs.append("mattes")
    if {*CHANNELS, *COLOURS}.intersection(frame.passes) or any(name.startswith(AOVS) for name in frame.passes):
        jobs.append("surface passes")
    if frame.camera.panorama:
        jobs.append("panorama")
    sources: list[Light | MeshState] = [*frame.lights, *frame.meshes]
    if any(source.receivers >= 0 or source.blockers >= 0 for source in sources):
        jobs.append("linked lights")
    if groups_of(frame.passes):
        jobs.append("light groups")
    return jobs + _jobs_of_lobes(frame, jobs)


def _jobs_of_lobes(frame: Frame, jobs: list[str]) -> list[str]:
    """Jobs of surfaces with more lobes than two: the kernel of paths takes some of the longest to compile."""
    if frame.settings.shading_model != "principled":
        return []
    if not any(material.has_more_lobes for mesh in frame.meshes for material in mesh.materials):
        return []
    kinds = {"linked lights": "linked paths", "light groups": "grouped paths"}
    paths = [own for lights, own in kinds.items() if lights in jobs] or ["paths"]
    coloured = {*COLOURS, *COLOURS.values()}.intersection(frame.passes)
    return paths + (["lobe colours"] if coloured else [])
