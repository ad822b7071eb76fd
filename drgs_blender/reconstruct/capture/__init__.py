"""A capture: calibrated photographs of one object, and the training views made of them."""
