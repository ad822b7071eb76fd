"""Values of surfels whose blend shows those of the mesh.

A surfel that takes the values of the one point where it hangs blurs them: neighbours overlap, and so does what they
carry. What they have to carry so that their blend shows the mesh's own colours and normals is found as in tomography
(SIRT, Gilbert 1972): several times each surfel takes its part of what the pixels that it covers lack, the mean of all
views. Taken view by view (SART) the last ones are shown best, and views left out worse than before.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ...core.arrays import Array
from ...core.asset.model import Mesh
from ...geometry.normals import unit
from ...render.scene.triangle_bvh import TriangleBVH
from ..capture.capture import View
from ..meshing.crops import cropped_views
from ..model.gaussians import Gaussians
from .pixels import pixels_of

#: How often views are gone through, how many of them at most, and the part of what lacks that is taken each time.
#: More brings views that are gone through alone.
_SWEEPS, _VIEWS, _RELAXATION = 4, 40, 0.5
#: Pixels that are covered less show other things.
_COVERED = 0.5
#: Least cosine between a surfel's normal and that of the mesh where it hangs: a farther one makes up for others alone.
_LEAST_COSINE = 0.8
#: Logit of an opacity that cannot be seen.
_INVISIBLE = -30.0


def blended_as(
    gaussians: Gaussians,
    visible: Array,
    start: Array,
    mesh: Mesh,
    values: Array,
    views: list[View],
    tell: Callable[[float], None] = lambda _: None,
    seconds: float | None = None,
) -> Array:
    """Values of surfels, so that views of them show those of the mesh's vertices.

    Parameters
    ----------
    gaussians : Gaussians
        On the CPU; they stay as they are.
    visible : (n,) bool array
        Surfels that are drawn.
    start : (n, c) float array
        Values to begin with; those of surfels that no view shows stay.
    mesh : Mesh
        World space.
    values : (v, c) float array
        Of its vertices.
    views : list of View
        Their cameras and masks say where the surface is seen, their photographs do not matter.
    tell : callable
        Called before each view with the part that is done; what it raises ends it.
    seconds : float, optional
        Of the wall clock: after the first round no other is begun that would take longer.

    Returns
    -------
    (n, c) float32 array
        Not held to the range of `values`: a blend that is as sharp may need more contrast.
    """
    tree = TriangleBVH(mesh.vertices, mesh.faces)
    still = gaussians.like({name: tensor.detach().clone() for name, tensor in gaussians.parameters.items()})
    for tensor in still.parameters.values():
        tensor.requires_grad_(False)
    still.parameters["opacity"][torch.from_numpy(~visible)] = _INVISIBLE
    cut = cropped_views(views, mesh.vertices)

    @functools.cache
    def wanted_of(k: int) -> tuple[Tensor, Tensor]:
        """Pixels of a view that see the mesh, and what they see."""
        pixels = pixels_of(k, cut[k], mesh, tree)
        shown = pixels.blended(values).astype(np.float32)
        return torch.from_numpy(pixels.place.astype(np.int64)), torch.from_numpy(shown)

    generator = np.random.default_rng(0)
    found = torch.from_numpy(np.asarray(start, np.float32).copy())
    count = min(len(cut), _VIEWS)
    began = time.monotonic()
    for sweep in range(_SWEEPS):
        if seconds is not None and sweep and (time.monotonic() - began) * (sweep + 1) > seconds * sweep:
            break
        lack, parts = torch.zeros_like(found), torch.zeros(len(found), 1)
        for done, k in enumerate(generator.permutation(len(cut))[:count]):
            tell((sweep + done / count) / _SWEEPS)
            place, wanted = wanted_of(k)
            # One more column, of zeros: its slope is the sum of a surfel's parts in all pixels.
            columns = torch.cat([found, torch.zeros(len(found), 1)], 1).requires_grad_(True)
            shown = still.render(cut[k].camera, torch.zeros(3), 0, reflections=False, materials=columns)
            assert shown.materials is not None
            alpha = shown.maps.alpha.detach().flatten()[place][:, None]
            blend = shown.materials.flatten(0, 1)[place] / alpha.clamp(min=_COVERED)
            weight = torch.cat([wanted - blend.detach()[:, :-1], torch.ones_like(alpha)], 1)
            (slope,) = torch.autograd.grad((blend * weight * (alpha > _COVERED)).sum(), columns)
            lack += slope[:, :-1]
            parts += slope[:, -1:]
        # Of surfels that are hardly seen a little at a time: what their few pixels lack is of others as well.
        found += _RELAXATION * lack / parts.clamp(min=1.0)
    return found.numpy()


def bounded(normals: Array, there: Array) -> Array:
    """Unit `normals` (n, 3) where they are within 37 degrees of `there`, those of the mesh, else these.

    Examples
    --------
    >>> bounded(np.array([[0, 0.6, 1.0], [0, 2.0, 1.0]]), np.array([[0, 0, 2.0], [0, 0, 2.0]])).round(2).tolist()
    [[0.0, 0.51, 0.86], [0.0, 0.0, 1.0]]
    """
    normals, there = unit(normals), unit(there)
    return np.where((normals * there).sum(axis=1, keepdims=True) > _LEAST_COSINE, normals, there)
