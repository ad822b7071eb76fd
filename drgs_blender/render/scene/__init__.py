"""The traced scene: triangle BVHs (Embree), instances, mesh materials, textures, ray masks, hits."""
