"""An evaluated scene -> the Frame the engine renders."""

from .frame import export_frame

__all__ = ["export_frame"]
