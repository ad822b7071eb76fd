"""The film: pixels, passes (AOVs), motion vectors, Cryptomatte, frame files.

The table of passes is `core.passes`; positions within pixels are drawn by `render.pixel_filter`.
"""
