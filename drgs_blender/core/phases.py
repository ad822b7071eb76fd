"""Names of what the engine does before it renders, as progress messages show them."""

from __future__ import annotations

#: While its process starts.
STARTING = "Starting the engine"
#: While kernels are compiled; ", 3 of 12" follows where they are counted.
PREPARING = "Preparing the engine (first time only)"


def is_preparing(phase: str) -> bool:
    """Whether kernels are compiled in a phase, counted or not."""
    return phase.startswith(PREPARING)


def is_counted(phase: str) -> bool:
    """Whether kernels are compiled whose number is known, so that the phase has a fraction of its own."""
    return is_preparing(phase) and phase != PREPARING
