"""Deformation on a graphics card; on the processor, by the same translation, for tests."""
