"""Which processor does the work of a frame: the one asked for, or this one with a warning that says why."""

from __future__ import annotations

from ...compute.warp.runtime import name_of, warp
from ...core.errors import DeviceError
from ...core.frame import RenderSettings
from ..backend import HERE, Processor
from .warp_backend import OnDevice

#: Failures after which a device is left alone; before, the next picture tries it again: its scene may be smaller.
_TRIES = 3


class Devices:
    """The processors of a session, each made when it is first asked for."""

    def __init__(self) -> None:
        self._known: dict[str, Processor] = {"cpu": HERE}
        self._missing: dict[str, str] = {}

    def processor(self, device: str) -> Processor:
        """The processor for a setting and a new picture; this one where that has none."""
        found = self._found(device)
        if found.failures < _TRIES:
            found.failed = ""
        return found

    def _found(self, device: str) -> Processor:
        if device not in self._known and device not in self._missing:
            try:
                self._known[device] = OnDevice(name_of(device))
            except DeviceError as error:
                self._missing[device] = str(error)
        return self._known.get(device, HERE)

    def warnings(self, settings: RenderSettings) -> list[str]:
        """What of the device asked for was not used, and why."""
        device = settings.device
        processor = self._found(device)
        why = self._missing.get(device) or processor.failed
        if why:
            return [f"{why} Rendered on the CPU"]
        if processor is not HERE and settings.rays_see == "surfels":
            return ["tracer surfels: not on a graphics card; rendered on the CPU"]
        return []


def card() -> str:
    """What is known of the card that "cuda" stands for.

    Raises
    ------
    DeviceError
        Where there is none.
    """
    device = warp().get_device(name_of("cuda"))
    return f"{device.name}, {device.total_memory / 2**30:.0f} GiB, sm_{device.arch}"
