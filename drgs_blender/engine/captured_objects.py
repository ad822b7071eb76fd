"""Objects shown in the colours of their capture: which they are, and the light that they give to others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.asset.model import Asset, PosedSurfels
from ..core.color import srgb_to_linear
from ..core.frame import Frame, MeshState, ObjectState
from ..core.materials import Image, Material, Texture
from ..render.scene.trace_scene import TraceObject
from ..render.surfels.captured import CapturedObject
from ..render.surfels.harmonics import CONSTANT

Array = np.ndarray


@dataclass(slots=True)
class Glow:
    """Colours of an asset's faces, as a texture of one texel each that emits.

    Attributes
    ----------
    image : Image
        Linear Rec.709 radiance.
    uvs : (m, 3, 2) float32 array
    """

    image: Image
    uvs: Array


def shows_captured(state: ObjectState, asset: Asset, frame: Frame) -> bool:
    """Whether the camera sees the object in the colours of its capture."""
    able = (
        frame.settings.camera_sees == "surfels"
        and not frame.camera.panorama
        and asset.surfels.sh is not None
        and len(asset.surfels) > 0
    )
    return state.captured_colours and able and not state.visibility.shadow_catcher


def captured_faults(state: ObjectState, asset: Asset, frame: Frame) -> list[str]:
    """What an object that is to be shown in captured colours lacks, in words for the user."""
    if not state.captured_colours:
        return []
    name, seen = state.name, state.visibility
    if asset.surfels.sh is None:
        return [
            f"{name}: {state.asset} has no captured colours, so it is lit as usual; assets imported from files of "
            "splats have them"
        ]
    if seen.shadow_catcher:
        return [f"{name}: is a shadow catcher, of which captured colours show nothing"]
    if frame.camera.panorama:
        return [f"{name}: is lit as usual, since panoramic cameras show no captured colours"]
    if frame.settings.camera_sees == "mesh":
        return [f"{name}: its captured colours are those of surfels; it is lit as usual while Camera Sees is Mesh"]
    if len(asset.mesh.faces) or not (seen.diffuse or seen.glossy or seen.shadow):
        return []
    if frame.settings.rays_see == "surfels":
        return [f"{name}: has no mesh, so reflections and indirect light see its materials, not its captured colours"]
    return [f"{name}: has no mesh, so others reflect no captured colours of it and get no shadow"]


def glow_of(asset: Asset, key: str) -> Glow:
    """What the faces of a bound asset emit when it is shown in captured colours: the mean over all directions.

    Of each vertex the mean of the surfels that hang on its faces, by opacity and area; of a vertex without any the
    albedo; of a face the mean of its corners.
    """
    surfels, mesh, binding = asset.surfels, asset.mesh, asset.binding
    total, colour = np.zeros(len(mesh.vertices)), np.zeros((len(mesh.vertices), 3))
    if binding is not None and surfels.sh is not None:
        own = srgb_to_linear(np.maximum(0.5 + CONSTANT * surfels.sh[:, 0], 0.0)).astype(np.float64)
        weight = binding.barycentric.clip(0, 1) * (surfels.opacity * surfels.scale.prod(axis=1))[:, None]
        for k in range(3):
            vertex, share = mesh.faces[binding.face, k], weight[:, k].astype(np.float64)
            total += np.bincount(vertex, share, len(total))
            for c in range(3):
                colour[:, c] += np.bincount(vertex, share * own[:, c], len(total))
    there = total > 0
    colour[there] /= total[there, None]
    colour[~there] = mesh.albedo[~there]
    faces = colour[mesh.faces].mean(axis=1)
    width = max(1, int(np.ceil(np.sqrt(len(faces)))))
    height = max(1, -(-len(faces) // width))
    pixels = np.zeros((height * width, 4), np.float32)
    pixels[: len(faces), :3], pixels[:, 3] = faces, 1.0
    row, column = np.divmod(np.arange(len(faces)), width)
    place = np.stack([(column + 0.5) / width, 1.0 - (row + 0.5) / height], axis=1).astype(np.float32)
    image = Image(f"captured colours of {key}", pixels.reshape(height, width, 4))
    return Glow(image, np.repeat(place[:, None], 3, axis=1))


def glowing_mesh(state: ObjectState, traced: TraceObject, glow: Glow) -> MeshState | None:
    """The object's mesh as one that rays see in captured colours; None where no ray does."""
    seen = state.visibility
    if not (seen.diffuse or seen.glossy or seen.shadow):
        return None
    faces, uvs = traced.faces, glow.uvs
    if traced.torn is not None:
        faces, uvs = faces[~traced.torn], uvs[~traced.torn]
    texture = Texture(glow.image.name, interpolation="closest", extension="extend")
    # A rough black metal reflects next to nothing.
    surface = Material("captured colours", (0.0, 0.0, 0.0), 1.0, 1.0, (1.0, 1.0, 1.0), emission_texture=texture)
    return MeshState(
        name=state.name,
        vertices=traced.vertices,
        faces=faces,
        matrices=np.eye(4)[None],
        pass_indices=np.array([state.pass_index], np.int32),
        uvs=uvs,
        materials=[surface],
        visibility=replace(seen, camera=False, holdout=False, shadow_catcher=False),
        light_group=state.light_group,
    )


def captured_object(state: ObjectState, asset: Asset, posed: PosedSurfels) -> CapturedObject:
    """The object as the camera sees it."""
    mirrored = bool(np.linalg.det(np.asarray(state.matrix_world, np.float64)[:3, :3]) < 0)
    return CapturedObject(posed, asset.surfels, mirrored)
