"""From datablocks to requests: their keys, and the files that a bake needs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...drgs_blender.core.errors import AssetError
from .. import messages, preferences
from ..property_limits import Limited
from . import node_trees
from .manager import Manager, Request, manager
from .store import Baked

#: Part of every key; raised when results are made in another way.
FORMAT = 1


class Wanted:
    """What one export finds baked, and what it wants.

    Attributes
    ----------
    requests : list of Request
        What is not there yet.
    world_size, texture_size : int
        Pixels along the longer side.
    """

    def __init__(self, world_size: int, texture_size: int, source: Manager = manager) -> None:
        self.requests: list[Request] = []
        self.world_size, self.texture_size = world_size, texture_size
        self._manager = source

    @classmethod
    def of(cls, scene: bpy.types.Scene, warn: Callable[[str], None] = lambda text: None) -> Wanted:
        """With the sizes of a scene's settings."""
        own = Limited(scene.drgs, f'Scene "{scene.name}"', warn)
        return cls(int(own.bake_world_size), int(own.bake_texture_size))

    def find(self, request: Request) -> Baked | None:
        """The result of a request; where it is not there, it is wanted from now on, unless it has `failed`."""
        found = self._manager.find(request.key)
        if found is not None:
            told = self._manager.told
            for text in told.pop(request.label, set()).difference(*told.values()):
                messages.withdraw("WARNING", text)
        elif not self.failed(request):
            self.requests.append(request)
        return found

    def tell(self, request: Request, text: str, warn: Callable[[str], None]) -> None:
        """Warn that a request could not be baked; where it is baked later, the message is withdrawn."""
        self.depends(request, text)
        warn(text)

    def depends(self, request: Request, *texts: str) -> None:
        """Have warnings that others give withdrawn when all requests on which they depend are baked."""
        self._manager.told.setdefault(request.label, set()).update(texts)

    def again(self, requests: Iterable[Request]) -> None:
        """Want what an earlier export has wanted already."""
        known = {request.key for request in self.requests}
        self.requests += [request for request in requests if request.key not in known]

    def end(self) -> None:
        """The export is over."""
        self._manager.store.end_export()

    def failed(self, request: Request) -> str:
        """Why the request could not be baked; "" where it could, or was not tried."""
        return self._manager.failed.get(request.key, "")


def request(
    kind: str,
    owner: bpy.types.ID,
    label: str,
    found: list[node_trees.Tree],
    about: dict[str, Any],
    change: Callable[[list[dict[str, Any]]], None] | None = None,
    write: Callable[[Path], None] | None = None,
    follow: node_trees.Follow = lambda socket: True,
) -> Request:
    """A bake of a node tree.

    Parameters
    ----------
    kind : name of the bake in `scripts/main.py`
    owner : evaluated datablock of the tree
    found : the trees and nodes that matter, with evaluated values
    about : what else the result depends on, JSON-able; part of the job
    change : changes the description of the trees, and with it the values that are baked
    write : writes further files into the folder of the job
    follow : whether an input matters
    """
    trees = node_trees.describe(found, follow)
    if change is not None:
        change(trees)
    frame = bpy.context.scene.frame_current if node_trees.moves(found) else 1
    facts = {"format": FORMAT, "blender": bpy.app.version[:2], "kind": kind, "trees": trees, "frame": frame} | about
    key = hashlib.blake2b(json.dumps(facts, sort_keys=True).encode(), digest_size=20).hexdigest()
    loose = [(place, i) for place, (_, i) in enumerate(node_trees.images(found)) if node_trees.is_loose(i)]

    def write_all(folder: Path) -> dict[str, Any]:
        for place, image in loose:
            np.save(folder / f"image-{place}.npy", node_trees.pixels_of(image))
        if write is not None:
            write(folder)
        threads = preferences.read("threads", 0)
        job = {"kind": kind, "source": _source(original, folder), "trees": trees, "frame": frame, "threads": threads}
        return job | about

    original = owner.original
    return Request(key, label, write_all)


def _source(owner: bpy.types.ID, folder: Path) -> dict[str, str]:
    """The file that holds a datablock and what it uses: the library it comes from, else one that is written here."""
    if owner.library is not None:
        path = bpy.path.abspath(owner.library.filepath, library=owner.library.parent)
        if not os.path.isfile(path):
            raise AssetError(path, "does not exist", "")
        return {"path": path, "name": owner.name}
    path = str(folder / "source.blend")
    bpy.data.libraries.write(path, {owner}, path_remap="ABSOLUTE")
    return {"path": path, "name": owner.name}
