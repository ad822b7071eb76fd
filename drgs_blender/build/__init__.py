"""Assets made from other files: mesh to surfels, import of splats, material transfer, proxy meshes, baking; export."""
