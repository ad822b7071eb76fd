"""A capture: calibrated photographs of one object, and the views that training uses."""
