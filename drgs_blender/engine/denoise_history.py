"""Histories of the temporal denoiser: what the session keeps of each sequence of pictures, by its name."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..core.arrays import Array, same_bits
from ..core.frame import Frame, World
from ..geometry.normals import rotation_between
from ..ipc.change_detection import reuse_equal
from ..render.camera import camera_parameters
from ..render.denoise.svgf_temporal import History
from ..render.film.light_passes import LIGHT_PASSES
from ..render.film.motion_vectors import SceneState
from ..render.prepared_scene import PreparedScene

#: Names of which the session keeps the history.
MAX_HISTORIES = 4


@dataclass(slots=True)
class Sequence:
    """One sequence.

    Attributes
    ----------
    history : History
        For the next picture; its scene state holds the scene's own arrays where nothing moved, which saves looking.
    past : SceneState, optional
        The scene at the last picture.
    fit : tuple
        Key under which the history is valid: layout of the scene, window, primary surface, split of light.
    situation : tuple
        All that decides what a picture shows; the same objects (``is``) as long as nothing changed.
    pictures : int
        How many have gone into the history.
    world : (3, 3) array, optional
        Rotation of the environment in the last picture.
    """

    history: History = field(default_factory=History)
    past: SceneState | None = None
    fit: tuple[Any, ...] = ()
    situation: tuple[Any, ...] = (None, None)
    pictures: int = 0
    world: Array | None = None


class Histories:
    """The last sequences that were continued."""

    def __init__(self) -> None:
        self._known: dict[str, Sequence] = {}

    def continued(self, frame: Frame, prepared: PreparedScene, static_state: tuple[Any, ...]) -> Sequence:
        """The sequence that `frame` continues, with what of it is of use.

        Parameters
        ----------
        frame : Frame
        prepared : PreparedScene
            The frame's.
        static_state : tuple
            Objects, meshes, images, world and lights of the frame, unchanged ones as the same objects.
        """
        settings, camera, scene = frame.settings, frame.camera, prepared.scene
        old = self._known.get(frame.history, Sequence())
        # How many samples are drawn, and which, is a matter of noise.
        lasting = replace(
            settings, seed=0, threads=0, device="cpu", samples=0, strategy_samples=None, noise_threshold=0.0
        )
        situation = reuse_equal(camera, old.situation[0]), reuse_equal(lasting, old.situation[1]), *static_state
        split = any(name in frame.passes for name in LIGHT_PASSES)
        fit = (
            scene.layout,
            scene.instances.shape,
            camera.window,
            camera.width,
            camera.height,
            settings.camera_sees,
            split,
        )
        if fit != old.fit or old.past is None:
            return Sequence(fit=fit, situation=situation)
        still = len(situation) == len(old.situation) and all(a is b for a, b in zip(situation, old.situation))
        scene_state = SceneState(
            scene.vertices if still or same_bits(old.past.vertices, scene.vertices) else old.past.vertices,
            scene.instances if still or same_bits(old.past.instances, scene.instances) else old.past.instances,
            old.past.parameters,
            prepared.unmeshed if still else old.past.surfels,
        )
        turned = not still and len(situation) == len(old.situation)
        turned = turned and all(a is b for a, b in zip(situation[1:], old.situation[1:]))
        past = old.history
        ages = past.ages if turned else None
        turn = 0.0 if still else world_turn(old.world, frame.world)
        history = History(past.signal, scene_state, still, turned, old.pictures, ages, turn)
        return Sequence(history, old.past, fit, situation, old.pictures)

    def store(self, frame: Frame, sequence: Sequence, prepared: PreparedScene) -> None:
        """Remember `sequence` after its picture `frame` was made."""
        before, past, scene = sequence.history.scene_state, sequence.past, prepared.scene
        sequence.past = SceneState(
            past.vertices if past and before and before.vertices is scene.vertices else scene.vertices.copy(),
            past.instances if past and before and before.instances is scene.instances else scene.instances.copy(),
            camera_parameters(frame.camera, frame.settings, frame.noise_index),
            prepared.unmeshed,
        )
        sequence.history.scene_state = None  # the scene's arrays are for this picture only
        sequence.world = np.array(frame.world.rotation, np.float64).reshape(3, 3)
        sequence.pictures += 1
        self._known.pop(frame.history, None)
        self._known[frame.history] = sequence
        while len(self._known) > MAX_HISTORIES:
            del self._known[next(iter(self._known))]


def world_turn(before: Array | None, world: World) -> float:
    """Angle by which the environment has turned since its rotation `before`, radians; 0 where there is no image."""
    if before is None or world.environment is None or not world.strength:
        return 0.0
    return rotation_between(before, np.asarray(world.rotation, np.float64).reshape(3, 3))
