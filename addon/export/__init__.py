"""Export: the evaluated depsgraph to the `Frame` that the engine renders; materials, lights, world, camera, meshes."""

from .final import export_baked
from .frame import export_frame

__all__ = ["export_baked", "export_frame"]
