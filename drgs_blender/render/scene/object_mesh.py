"""Meshes of DR-GS objects that are laid out as ordinary meshes."""

from __future__ import annotations

from dataclasses import dataclass

from ...core.frame import MeshState


@dataclass(slots=True)
class ObjectMesh(MeshState):
    """An object mesh: that of a DR-GS object with materials of its own, laid out as a mesh of one instance.

    Attributes
    ----------
    owner : int
        Which of the scene's objects it is; that `TraceObject` has no faces.
    seen_only : bool
        As of `TraceObject`.
    beside : bool
        Whether the camera meets it next to the surfels.
    tied : bool
        Whether surfels are tied to it even so.
    """

    owner: int = 0
    seen_only: bool = False
    beside: bool = False
    tied: bool = False

    @property
    def clear(self) -> bool:
        """Whether light may pass it; no surfels are tied to it then, and the camera sees it next to those of others."""
        return any(material.clear for material in self.materials)

    @property
    def ordinary(self) -> bool:
        """Whether the camera meets it as it does ordinary meshes."""
        return self.beside or self.clear
