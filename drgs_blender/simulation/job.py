"""A simulation job, from an asset and settings to a solver: fill, materials, pins, colliders, domain."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..core.asset.model import Mesh
from ..core.errors import AssetError, DeviceError, UsageError
from ..core.particle_cache import ParticleFrame
from ..core.sim_materials import particle_materials
from ..deform.gmls import Weights, bind_points, carry
from ..deform.gpu.gmls import Carrier
from ..deform.sources import MeshSource
from ..formats.registry import read_mesh
from .colliders import Collider, lift_surface
from .contact import Plane
from .fields import FAR
from .fill import Filling, fill
from .grid_blocks import Domain
from .input_digest import digest_of, moves_of
from .rigid import Rigid
from .settings import Region, Settings
from .solver import Body, Forces, Solver
from .stepper import Stepper
from .xpbd import Lattice

Array = np.ndarray
log = logging.getLogger(__name__)

#: Particles a cell of the grid along each axis.
PER_CELL = 2
#: Displacement of particles, in their spacings, of matter that shows rows of particles otherwise.
_JITTER = 0.8
#: Blocks of cells that a domain may have: a body of 400 cells and three times its size around it.
_MOST_BLOCKS = 1 << 29


@dataclass(slots=True)
class Job:
    """A simulation ready to run.

    Attributes
    ----------
    settings : Settings
    filling : Filling
        Particles at rest, world.
    solver : Stepper
        At the beginning.
    digest : str
        Of what all frames depend on, see `digest`.
    moves : list of str
        Of what moves in each frame.
    tear, grain : float
        See `frame.ObjectState`.
    """

    settings: Settings
    filling: Filling
    solver: Stepper
    digest: str
    moves: list[str]
    tear: float
    grain: float
    _spacing: float
    _vertices: Array
    _carried: _Carried | None
    _pins: _PinMotion | None

    def rest(self) -> ParticleFrame:
        """Particles and mesh at rest, object space."""
        return self._to_object(
            self.filling.points, np.tile(np.eye(3), (len(self.filling.points), 1, 1)), self._vertices
        )

    def now(self) -> ParticleFrame:
        """Particles and mesh as they are now, object space."""
        solver = self.solver
        vertices = self._surface()
        if solver.frame:
            vertices = lift_surface(vertices, self._spacing, solver.colliders, solver.planes)
        return self._to_object(solver.points, solver.gradients, vertices)

    def _surface(self) -> Array:
        """Vertices of the mesh as matter carries them, world."""
        return self.solver.markers if self._carried is None else self._carried.vertices(self.solver)

    def _to_object(self, points: Array, gradients: Array, vertices: Array) -> ParticleFrame:
        matrix = np.asarray(self.settings.matrix_world)
        back = np.linalg.inv(matrix)
        linear = back[:3, :3]
        if not np.array_equal(matrix, np.eye(4)):
            points, vertices = (p @ linear.T + back[:3, 3] for p in (points, vertices))
            gradients = linear @ gradients @ matrix[:3, :3]
        return ParticleFrame(points.astype(np.float32), gradients, vertices.astype(np.float32))

    @property
    def cells(self) -> list[list[float]]:
        """See `frame.Particles`."""
        space, to_cells = self.filling.space, np.eye(4)
        to_cells[:3, :3] /= space.spacing
        to_cells[:3, 3] = -space.origin / space.spacing
        found: list[list[float]] = (to_cells @ np.asarray(self.settings.matrix_world)).tolist()
        return found

    def pin_targets(self, frame: int) -> Array | None:
        """World positions of pinned points `frame` frames after the start; None where they stay."""
        return None if self._pins is None else self._pins.at(frame)


class _Carried:
    """A mesh that matter carries: on the solver's device, or here once that has failed."""

    def __init__(self, weights: Weights) -> None:
        self._weights = weights
        self._carrier: Carrier | None = None
        self._failed = False

    def vertices(self, solver: Stepper) -> Array:
        """(n, 3) float64, world."""
        vertices, _, turned = self._carry(solver)
        if turned:
            log.debug("frame %d: %d vertices where matter would be inside out", solver.frame, turned)
        return vertices

    def _carry(self, solver: Stepper) -> tuple[Array, Array, int]:
        given, launcher = (solver.points, solver.gradients), solver.launcher
        if launcher is not None and not self._failed:
            try:
                self._carrier = self._carrier or Carrier(self._weights, launcher)
                return self._carrier.carry(*given)
            except DeviceError as error:
                log.warning("%s The mesh is carried on the CPU from frame %d on", error, solver.first + solver.frame)
                self._carrier, self._failed = None, True
        return carry(self._weights, *given)


class _PinMotion:
    """Pinned points that follow the animated mesh."""

    def __init__(self, mesh: Mesh, motion: Array, points: Array, matrix: Array) -> None:
        self.rows = motion
        self._matrix = matrix
        rest = motion[0] @ matrix[:3, :3].T + matrix[:3, 3]
        self._source = MeshSource(rest, mesh.faces)
        self._weights = bind_points(points, rest)

    def at(self, frame: int) -> Array:
        now = self.rows[min(frame, len(self.rows) - 1)] @ self._matrix[:3, :3].T + self._matrix[:3, 3]
        return carry(self._weights, now, self._source.gradients(now))[0]


def placed(mesh: Mesh, settings: Settings, name: str = "mesh") -> tuple[Array, float]:
    """Vertices of a mesh in the world, (n, 3) float64, and its longest side, metres.

    Raises
    ------
    AssetError
        There is nothing that could be filled.
    """
    matrix = np.asarray(settings.matrix_world, np.float64)
    vertices = mesh.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    used = vertices[np.unique(mesh.faces)] if len(mesh.faces) else vertices[:0]
    if not len(used) or not np.isfinite(used).all():
        raise AssetError(name, "has no faces, or vertices that are not finite", "Clean the mesh up")
    size = float(np.ptp(used, axis=0).max())
    if size <= 0:
        raise AssetError(name, "has no size", "Choose a mesh with an interior")
    return vertices, size


def prepare(mesh: Mesh, settings: Settings, name: str = "mesh", domain: Domain | None = None) -> Job:
    """Fill the mesh and set its simulation up.

    Parameters
    ----------
    mesh : Mesh
        The asset's, object space.
    settings : Settings
    name : str
        Of it, in messages.
    domain : Domain, optional
        The grid, which bodies that push each other share; by default the settings say which.

    Raises
    ------
    AssetError, UsageError
        With what to do about it.
    """
    matrix = np.asarray(settings.matrix_world, np.float64)
    vertices, size = placed(mesh, settings, name)
    faces = mesh.faces if np.linalg.det(matrix[:3, :3]) > 0 else mesh.faces[:, ::-1]
    spacing = size / settings.resolution if domain is None else domain.spacing
    materials = [settings.material, *(material for _, material in settings.regions)]
    loose = [not m.keeps_shape for m in materials]
    colliders, motion = _colliders(settings), _motion(settings, mesh)
    jitter = settings.jitter if settings.jitter is not None else (_JITTER if any(loose) else 0.0)
    filling = fill(vertices, faces, spacing / PER_CELL, jitter=jitter, seed=settings.seed, name=name)
    points = filling.points
    nearest = cKDTree(vertices).query(points, workers=-1)[1]

    def chosen(region: Region, what: str) -> Array:
        mask = np.ones(len(points), bool)
        if region.group is not None:
            if region.group not in mesh.groups:
                raise UsageError(f"{what}, group {region.group!r}", "is not in the asset", _has(list(mesh.groups)))
            members = np.zeros(len(vertices), bool)
            members[mesh.groups[region.group]] = True
            mask &= members[nearest]
        if region.box is not None:
            low, high = np.asarray(region.box)
            mask &= ((points >= low) & (points <= high)).all(axis=1)
        if not mask.any():
            part = f"{what}, group {region.group!r}" if region.group is not None else what
            raise UsageError(part, "contains no particle", "Choose a larger group or box")
        return mask

    which = np.zeros(len(points), np.int64)
    for i, (region, _) in enumerate(settings.regions, 1):
        which[chosen(region, f"region {i}")] = i
    pinned = np.zeros(len(points), bool)
    for i, region in enumerate(settings.pins, 1):
        pinned |= chosen(region, f"pin {i}")

    centre = points.mean(axis=0)
    velocity = np.asarray(settings.velocity) + np.cross(np.asarray(settings.spin), points - centre)
    rides = any(loose[i] for i in np.unique(which))
    body = Body(
        points,
        filling.volume,
        particle_materials(materials, which),
        vertices if rides else np.empty((0, 3)),
        pinned,
        velocity,
        None if domain is None else _way_out(points, vertices, faces),
        "the body" if domain is None else f'body "{name}"',
    )
    carried = None
    if not rides:
        carried = _Carried(bind_points(vertices, points, space=filling.space, parts=filling.part))
    if domain is None:
        domain = domain_of(*extent(settings, np.concatenate([points, vertices]), spacing), spacing, settings.floor)
    solver = _solver(settings, body, domain, colliders)
    solver.first = settings.first
    pins = None if motion is None or not pinned.any() else _PinMotion(mesh, motion, points[pinned], matrix)
    log.info("%d particles, %d time steps a frame at least", len(points), solver.steps_of(1 / settings.fps))
    moved = None if pins is None else pins.rows
    digest, moves = digest_of(mesh, settings, colliders, moved), moves_of(settings, colliders, moved)
    tear = max(m.gap for m in materials) * spacing / abs(float(np.linalg.det(matrix[:3, :3]))) ** (1 / 3)
    grain = min(m.grain for m in materials)
    return Job(settings, filling, solver, digest, moves, tear, grain, spacing, vertices, carried, pins)


def _way_out(points: Array, vertices: Array, faces: Array) -> Array:
    """(n, 3) from points to the nearest place of a surface, metres."""
    import igl

    found: Array = igl.point_mesh_squared_distance(points, vertices, np.ascontiguousarray(faces, np.int64))[2] - points
    return found


def _has(names: Sequence[str]) -> str:
    return f"There are {', '.join(names)}" if names else "It has no vertex groups; use a box"


def _solver(settings: Settings, body: Body, domain: Domain, colliders: list[Collider]) -> Stepper:
    forces = Forces(settings.gravity, settings.wind, settings.drag, settings.damping, settings.fields)
    planes = []
    if settings.floor is not None:
        planes.append(Plane((0, 0, settings.floor), (0, 0, 1), settings.floor_contact, settings.floor_friction))
    if settings.walls != "open":
        for axis in range(3):
            for corner, sign in ((domain.low, 1.0), (domain.high, -1.0)):
                normal = tuple(sign * float(i == axis) for i in range(3))
                # One cell inside: matter at a wall must not be outside the domain.
                point = tuple((corner + sign * domain.spacing * np.asarray([1.0, 1.0, 1.0])).tolist())
                planes.append(Plane(point, normal, settings.walls))  # type: ignore[arg-type]
    if settings.solver != "mpm":
        if settings.device != "cpu":
            log.warning("device %s: only the solver mpm works on it; simulated on the CPU", settings.device)
        return {"xpbd": Lattice, "rigid": Rigid}[settings.solver](body, forces, colliders, planes)
    return Solver(body, domain, forces, colliders, planes, settings.courant, settings.device)


def extent(settings: Settings, points: Array, spacing: float) -> tuple[Array, Array]:
    """Corners of the space simulated: what the settings say, else the body and three times its size around it.

    It goes no deeper than what stops a fall.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    if settings.domain is not None:
        given = np.asarray(settings.domain)
        if (low < given[0]).any() or (high > given[1]).any():
            raise UsageError(
                "domain",
                "does not contain the body at the start",
                f"It must reach from {np.round(low, 3).tolist()} to {np.round(high, 3).tolist()} at least",
            )
        return given[0], given[1]
    size = float((high - low).max())
    floor = settings.floor
    bottom = low[2] - 3 * size if floor is None else min(floor, points[:, 2].min()) - 6 * spacing
    return np.array([*(low[:2] - 3 * size), bottom]), high + 3 * size


def domain_of(low: Array, high: Array, spacing: float, floor: float | None = None) -> Domain:
    """The grid between two corners; with a layer of nodes on the floor itself."""
    if floor is not None:
        low = np.array([*low[:2], floor - (np.ceil((floor - low[2]) / spacing) + 0.5) * spacing])
    domain = Domain.around(low, high, spacing)
    if np.prod(domain.blocks, dtype=float) > _MOST_BLOCKS:
        sides = " x ".join(f"{length:.3g}" for length in high - low)
        problem = f"of {sides} m is too large for cells of {spacing:.3g} m"
        raise UsageError("domain", problem, "Make it smaller, or the resolution lower")
    return domain


def _colliders(settings: Settings) -> list[Collider]:
    found = []
    for obstacle in settings.colliders:
        file = read_mesh(Path(obstacle.mesh))
        vertices = file.vertices if obstacle.vertices is None else _load(obstacle.vertices)
        found.append(
            Collider(obstacle.mesh, file.faces, vertices, obstacle.contact, obstacle.friction, obstacle.thickness)
        )
    return found


def _motion(settings: Settings, mesh: Mesh) -> Array | None:
    """Vertices of the animated mesh, (frames, n, 3); None without."""
    if settings.motion is None:
        return None
    motion = _load(settings.motion)
    if motion.ndim != 3 or not len(motion) or motion.shape[1:] != mesh.vertices.shape:
        expected = f"(frames, {len(mesh.vertices)}, 3)"
        raise UsageError(
            f"motion {settings.motion}", f"has shape {motion.shape}, expected {expected}", "Export it from this mesh"
        )
    return motion


def _load(path: str) -> Array:
    """Positions of a .npy file, metres."""
    if Path(path).exists() and not Path(path).is_file():
        raise UsageError(path, "is not a regular file", "Choose a .npy file")
    try:
        array = np.load(path, allow_pickle=False)
    except OSError as error:
        raise UsageError(path, f"cannot be read ({error.strerror or error})", "Check the path") from error
    except (ValueError, EOFError) as error:  # numpy's own words recommend pickle
        raise UsageError(path, "is no .npy file of numbers", "Save it with numpy.save") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" or not (np.abs(array) <= FAR).all():
        problem = f"does not hold numbers from {-FAR:g} to {FAR:g}"
        raise UsageError(path, problem, "Save positions in metres with numpy.save")
    return array.astype(np.float64)
