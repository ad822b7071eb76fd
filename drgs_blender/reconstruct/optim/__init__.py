"""The optimiser and the training of stage (i)."""
