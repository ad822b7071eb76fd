"""DR-GS: captured objects as 2D Gaussian surfels, deformed and relit.

This package is the engine and its library; it never imports ``bpy``. Importing it costs nothing: torch,
numba and Embree are imported only by the modules that compute with them.
"""

from .core.version import __version__

__all__ = ["__version__"]
