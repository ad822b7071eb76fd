"""The G-buffer, what the camera sees, from surfels and from meshes."""
