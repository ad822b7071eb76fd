"""What rays meet: triangles in one BVH, instances, materials, textures."""
