"""Denoisers: SVGF in space and over time, OIDN."""
