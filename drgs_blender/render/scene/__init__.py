"""The traced scene: triangles in one BVH, instances, materials, textures."""
