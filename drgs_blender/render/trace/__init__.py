"""What rays meet: triangles, instances, materials, in one tree."""
