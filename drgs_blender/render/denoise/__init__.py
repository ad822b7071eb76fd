"""The denoiser: SVGF in space and over time, or OIDN."""
