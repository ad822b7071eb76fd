"""File formats: readers and writers of meshes, splats, images and environments, behind one registry."""
