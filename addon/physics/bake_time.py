"""How long a bake takes."""

from __future__ import annotations

from ..physics_settings import DrgsPhysicsSettings

#: Steps of particles that a core makes in a second at best (bench/bench_simulate.py measures it), and in the preview
#: (XPBD).
_RATE, _QUICK = 1.2e7, 1.5e8
#: Seconds that the start takes, a frame besides, and a particle in it.
_START, _FRAME, _KEEP = 3.0, 0.02, 5e-7


def estimate(physics: DrgsPhysicsSettings, counts: tuple[int, int], cores: int) -> float:
    """Seconds that a bake takes at least, from particles and time steps a frame."""
    particles, steps = counts
    rate = _RATE if physics.solver == "mpm" else _QUICK
    frame = _FRAME + _KEEP * particles + particles * steps / (rate * max(1, cores) ** 0.85)
    return _START + (physics.frame_end - physics.frame_start) * frame


def clock(seconds: float) -> str:
    """A duration in words."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
