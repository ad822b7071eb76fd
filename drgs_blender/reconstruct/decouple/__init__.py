"""Stage (ii): albedo, roughness, metallic and the light around an object, from photographs and its geometry."""
