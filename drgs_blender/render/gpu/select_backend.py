"""Selects the backend of a frame: the one that is asked for, or the CPU with a warning and its reason."""

from __future__ import annotations

from ...compute.warp.runtime import name_of, warp
from ...core.errors import DeviceError
from ...core.frame import RenderSettings
from ..backend import CPU, RenderBackend

#: Failures after which a device is left alone; before, the next picture tries it again: its scene may be smaller.
_TRIES = 3


class Backends:
    """The backends of a session, each made when it is first asked for."""

    def __init__(self) -> None:
        self._known: dict[str, RenderBackend] = {"cpu": CPU}
        self._missing: dict[str, str] = {}

    def select(self, device: str) -> RenderBackend:
        """The backend for the setting `device` and a new frame; the CPU where there is no such device."""
        found = self._found(device)
        if found.failures < _TRIES:
            found.failed = ""
        return found

    def _found(self, device: str) -> RenderBackend:
        if device not in self._known and device not in self._missing:
            from .warp_backend import WarpRenderBackend  # ten modules, which few starts need

            try:
                self._known[device] = WarpRenderBackend(name_of(device))
            except DeviceError as error:
                self._missing[device] = str(error)
        return self._known.get(device, CPU)

    def warnings(self, settings: RenderSettings, linked: bool = False, by_paths: bool = False) -> list[str]:
        """Warnings: which requested device was not used, and why.

        Parameters
        ----------
        settings : RenderSettings
        linked : bool
            Whether lights are linked (`light_links`), or in groups.
        by_paths : bool
            Whether surfaces have more lobes than two (`backend.needs_paths`).
        """
        device = settings.device
        backend = self._found(device)
        why = self._missing.get(device) or backend.failed
        if why:
            return [f"{why} Rendered on the CPU"]
        if backend is not CPU and settings.rays_see == "surfels":
            return ["Rays See: Surfels is not supported on a graphics card; rendered on the CPU"]
        if backend is not CPU and linked:
            return ["Light linking is not supported on a graphics card; light is traced on the CPU"]
        if backend is not CPU and by_paths:
            what = "Coat, sheen, glass and other BSDFs than diffuse and glossy"
            return [f"{what} are not supported on a graphics card; light is traced on the CPU"]
        return []


def card() -> str:
    """Properties of the card that "cuda" stands for.

    Raises
    ------
    DeviceError
        Where there is none.
    """
    device = warp().get_device(name_of("cuda"))
    return f"{device.name}, {device.total_memory / 2**30:.0f} GiB, sm_{device.arch}"
