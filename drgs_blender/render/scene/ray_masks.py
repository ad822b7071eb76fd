"""Ray masks, for ray visibility: which rays meet which objects, as bits of a group and of a ray."""

from __future__ import annotations

from ...core.frame import Visibility

#: Kinds of rays. DIFFUSE and GLOSSY are indirect rays from such a scattering, SHADOW those towards light.
CAMERA, DIFFUSE, GLOSSY, SHADOW = 1, 2, 4, 8
#: Every DR-GS mesh, whatever sees it: what surfels are tied to.
SURFELS = 16
#: What the camera sees of ordinary meshes, next to surfels.
ORDINARY = 32
#: ``kind << WITHOUT``: rays of that kind in a world of shadow catchers alone, without what throws shadows on them.
WITHOUT = 8

#: ``mask << CLEAR``: meshes that light may pass, in place of the bits of others.
CLEAR = 16
#: Bits of shadow linkings: rays towards their lights meet what throws their shadows. No kind of rays has them, and so
#: they are free beyond ``CLEAR`` as well.
LINKED = (6, 7, 8, 12, 13, 14)

#: Bits of ``TraceScene.object_flags``.
HOLDOUT, CATCHER = 1, 2


def group_mask(visibility: Visibility, surfels: bool, seen_only: bool = False, clear: bool = False) -> int:
    """Mask of what has this visibility; `surfels` is true for DR-GS meshes.

    Of a DR-GS mesh that is `seen_only`, light does not meet the triangles; light may pass what is `clear`.
    """
    v = visibility
    kinds = DIFFUSE * v.diffuse | GLOSSY * v.glossy | SHADOW * v.shadow
    mask = CAMERA * v.camera | kinds
    if v.shadow:
        mask |= sum((v.blocks >> number & 1) << bit for number, bit in enumerate(LINKED))
    if v.shadow_catcher:
        mask |= kinds << WITHOUT
    if surfels:
        return (mask & CAMERA if seen_only else mask) | SURFELS
    mask |= ORDINARY * v.camera
    return mask << CLEAR if clear else mask


def blocker_mask(blockers: int) -> int:
    """Mask of the shadow rays of a light with this shadow linking; 0 without."""
    return 1 << LINKED[blockers] if 0 <= blockers < len(LINKED) else 0


def object_flags(visibility: Visibility) -> int:
    """HOLDOUT and CATCHER."""
    return HOLDOUT * visibility.holdout | CATCHER * visibility.shadow_catcher
