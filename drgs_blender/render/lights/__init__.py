"""What shines: the world and Blender's lights."""
