"""Packets of rays: the room that their fields have."""

from __future__ import annotations

from drgs_blender.render.integrator import wavefront as w


def test_a_packet_has_room_for_its_fields_and_a_width_that_is_fast() -> None:
    """At a width that four fields do not divide, the same kernel takes a tenth longer."""
    last = max(value for name, value in vars(w).items() if name in w.IN_LANES and not name.startswith("PACKET"))
    assert last < w.PACKET_FLOATS and w.PACKET_FLOATS % (4 * w.LANES) == 0
