"""Frames of the demos' scenes and of the film's parts, for the scripts inside Blender and outside."""

#: Last frame of the demo, and of the simulated shots.
FRAMES, SIMULATED = 24, 48
#: Last frames of the turntable: in the captured light; while the camera turns; while another light turns.
CAPTURED, ROUND, TURN = 12, 46, 64
#: First and last frame of each shot on the stage.
SHOTS = {"jelly": (1, 22), "bones": (23, 44), "gold": (51, 70), "night": (75, 110)}
