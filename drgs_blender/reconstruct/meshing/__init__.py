"""Meshing: visual hull, TSDF fusion of depth maps, silhouette fit, normal integration; the result is a closed mesh."""
