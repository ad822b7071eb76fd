"""The general BSDF: Blender's Principled BSDF whole and its pure BSDFs, as a list of weighted lobes."""
