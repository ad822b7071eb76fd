"""What the camera sees, before light."""
