"""Training of stage (i): the optimiser (Adam), densification and pruning, schedules, training views."""
