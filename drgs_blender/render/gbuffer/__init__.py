"""What the camera sees: the G-buffer, from surfels and from meshes."""
