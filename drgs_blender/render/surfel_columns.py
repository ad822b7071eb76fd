"""Columns of the float32 records of surfaces: vertices, splats, their samples, surfels that rays meet.

All begin alike: unit shading normal, albedo (linear Rec.709), roughness, metallic; those of surfels go on with their
larger standard deviation, metres.
"""

NORMAL, ALBEDO, ROUGHNESS, METALLIC, SIZE = 0, 3, 6, 7, 8
#: Columns of a vertex, and of a sample of blended splats.
VERTEX, SAMPLE = 8, 9
#: Of a splat: its opacity; columns.
OPACITY, SPLAT = 9, 10
#: Of a surfel that rays meet: unit normal of its plane; columns.
PLANE, SURFEL = 9, 12
