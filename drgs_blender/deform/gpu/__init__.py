"""Deformation on a graphics card; on the CPU, by the same translation, for tests."""
