"""Stage (ii): albedo, roughness, metallic and environment from photographs and geometry."""
