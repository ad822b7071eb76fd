"""Geometry of triangle meshes: vertex normals, occupancy."""
