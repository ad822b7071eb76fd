"""Geometry of surfaces: vertex normals, occupancy, signed distance fields (TSDF)."""
