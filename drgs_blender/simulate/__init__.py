"""Matter: particles that fill a mesh, their motion, and the frames that it leaves on disk."""
