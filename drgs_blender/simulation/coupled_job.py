"""Several bodies that push each other, from assets and settings to a solver: one grid for all of them."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace

import numpy as np

from ..core.asset.model import Mesh
from ..core.errors import AssetError, UsageError
from .colliders import Collider, MovingCollider, check_apart
from .coupled import Coupled
from .coupled_settings import BodySettings, CoupledSettings
from .grid_blocks import Domain
from .job import Job, domain_of, extent, placed, prepare
from .settings import Settings
from .solver import Solver

Array = np.ndarray
log = logging.getLogger(__name__)

#: Cells along the longest side of a body that it needs, and below which it is said that they are few.
_FEWEST, _FEW = 4, 8


@dataclass(slots=True)
class CoupledJob:
    """A simulation of several bodies, ready to run.

    Attributes
    ----------
    bodies : list of BodySettings
    jobs : list of Job
        Of the bodies, with the digests of all: each frame of one depends on all others.
    solver : Coupled
        At the beginning.
    """

    bodies: list[BodySettings]
    jobs: list[Job]
    solver: Coupled

    @property
    def settings(self) -> Settings:
        """Those of the first body: frames are the same for all."""
        return self.jobs[0].settings

    def pin_targets(self, frame: int) -> list[Array | None]:
        """See `Job.pin_targets`."""
        return [job.pin_targets(frame) for job in self.jobs]


def prepare_coupled(meshes: Sequence[Mesh], scene: CoupledSettings) -> CoupledJob:
    """Fill the meshes and set their simulation up.

    Cells are as long for all bodies: the `resolution` of the largest counts them along its longest side.

    Parameters
    ----------
    meshes : sequence of Mesh
        Those of the bodies, object space.
    scene : CoupledSettings

    Raises
    ------
    AssetError, UsageError
        Naming the body, with what to do about it.
    """
    bodies = list(scene.bodies)
    vertices, sizes = [], []
    for mesh, body in zip(meshes, bodies, strict=True):
        with _about(body):
            found, size = placed(mesh, body.settings, body.name)
        vertices.append(found)
        sizes.append(size)
    domain, resolution = _grid(bodies, vertices, sizes)
    if any(body.settings.device != "cpu" for body in bodies):
        log.warning("device %s: bodies that push each other are simulated on the CPU", bodies[0].settings.device)
    jobs, solvers = [], []
    for mesh, body in zip(meshes, bodies, strict=True):
        settings = replace(body.settings, resolution=resolution, device="cpu")
        with _about(body):
            job = prepare(mesh, settings, body.name, domain)
        assert isinstance(job.solver, Solver), "of mpm"
        job.solver.subject = f'body "{body.name}"'
        jobs.append(job)
        solvers.append(job.solver)
    _check_apart(bodies, jobs, vertices, meshes)
    _join_digests(jobs, scene, domain)
    return CoupledJob(bodies, jobs, Coupled(solvers, scene.touches))


@contextmanager
def _about(body: BodySettings) -> Iterator[None]:
    """Errors name the body."""
    try:
        yield
    except (AssetError, UsageError) as error:
        if error.subject == body.name or f'"{body.name}"' in error.subject:
            raise
        raise type(error)(f'body "{body.name}", {error.subject}', error.problem, error.remedy) from error


def _grid(bodies: Sequence[BodySettings], vertices: Sequence[Array], sizes: Sequence[float]) -> tuple[Domain, int]:
    """The grid of all bodies, and the resolution of the largest."""
    largest = int(np.argmax(sizes))
    resolution = bodies[largest].settings.resolution
    spacing = sizes[largest] / resolution
    for body, size in zip(bodies, sizes, strict=True):
        cells = size / spacing
        told = f"is {cells:.3g} cells long, as cells are {spacing:.3g} m for all bodies"
        needed = int(np.ceil(resolution * _FEW / cells))
        remedy = f'Raise the resolution of the largest, "{bodies[largest].name}", from {resolution} to {needed}'
        if cells < _FEWEST:
            raise UsageError(f'body "{body.name}"', told, remedy)
        if cells < _FEW:
            log.warning('body "%s": %s; it bends and touches coarsely. %s', body.name, told, remedy)
    corners = []
    for body, points in zip(bodies, vertices, strict=True):
        with _about(body):
            corners.append(extent(body.settings, points, spacing))
    floors = [body.settings.floor for body in bodies if body.settings.floor is not None]
    low, high = np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)
    return domain_of(low, high, spacing, min(floors, default=None)), resolution


def _check_apart(
    bodies: Sequence[BodySettings], jobs: Sequence[Job], vertices: Sequence[Array], meshes: Sequence[Mesh]
) -> None:
    """Refuse bodies that are inside of each other, as a body that is in a collider."""
    boxes = [(points.min(axis=0), points.max(axis=0)) for points in vertices]
    for i, job in enumerate(jobs):
        spacing = job.solver.domain.spacing  # type: ignore[attr-defined]
        for j, (low, high) in enumerate(boxes):
            if i != j and (low < boxes[i][1]).all() and (boxes[i][0] < high).all():
                obstacle = Collider(f'body "{bodies[j].name}"', meshes[j].faces, vertices[j])
                moving = MovingCollider(obstacle, spacing, boxes[i][0] - 2 * spacing, boxes[i][1] + 2 * spacing)
                check_apart(job.filling.points, spacing, [moving], np.empty((0, 6)), f'"{bodies[i].name}"')


def _join_digests(jobs: Sequence[Job], scene: CoupledSettings, domain: Domain) -> None:
    """Give each job a digest of all bodies, and of how all of them move."""
    touches = [[*pair, touch.contact, touch.friction] for pair, touch in sorted(scene.touches.items())]
    grid = [domain.origin.tolist(), domain.spacing, domain.blocks]
    together = json.dumps([[job.digest for job in jobs], touches, grid])
    longest = max(len(job.moves) for job in jobs)
    moves = [
        hashlib.sha256("".join((job.moves[: frame + 1] or [""])[-1] for job in jobs).encode()).hexdigest()[:16]
        for frame in range(longest)
    ]
    for i, job in enumerate(jobs):
        job.digest = hashlib.sha256(f"{i} {together}".encode()).hexdigest()
        job.moves = list(moves)


def about_others(job: CoupledJob, index: int) -> dict[str, object]:
    """What the header of a body's cache says: its settings, and which bodies it was baked with, in their order."""
    bodies = [{"name": body.name, "folder": str(body.out)} for body in job.bodies]
    return asdict(job.jobs[index].settings) | {"coupled": bodies}
