"""The node tree of a glTF file: transforms of meshes, and skinning.

Two poses. "rest" is what Blender shows with armatures in rest position after its own import: bones lie where the
inverse bind matrices put them (as far as these are known; the node's default pose else), without scale. It is the
pose against which vertex weights can be transferred by position. "default" is the pose that glTF viewers show.
Without skins the two are the same. The rules of "rest" are the behaviour of Blender 5.0's importer with its default
settings, with one surprise: it hangs rigid children on the tip of a bone whose length it divides by the scale of the
armature, but steps back by the undivided length.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from ..core.errors import AssetError
from ..geometry.normals import rotation_matrices
from .gltf_document import Document

Array = np.ndarray
Pose = Literal["rest", "default"]

#: Distances below it make no bone in Blender's importer.
SHORTEST_BONE = 0.004
#: The extension with which a node places its mesh many times.
INSTANCES = "EXT_mesh_gpu_instancing"
#: Stands above all root nodes.
ROOT = -1


class NodeTree:
    """Transforms of all nodes of the default scene.

    Parameters
    ----------
    document : Document
        An open glTF file.
    pose : {"rest", "default"}
        "rest" or "default", see above.
    """

    def __init__(self, document: Document, pose: Pose = "rest") -> None:
        self.document, self.pose = document, pose
        nodes = document.items("nodes")
        self.parent = self._parents(nodes)
        self.local = [self._local(node) for node in nodes]
        self.skins = [self._skin(skin) for skin in document.items("skins")]
        self.order = self._reachable(nodes)
        self._bind_local: dict[int, Array] = {}
        self._tip: dict[int, Array] = {}  # bone -> what its children that are no bones are shifted by
        if pose == "rest":
            self._find_bones()
        self._worlds: dict[int, Array] = {ROOT: np.eye(4)}

    def world(self, node: int) -> Array:
        """(4, 4) node-to-scene matrix in this pose."""
        path = []
        while node not in self._worlds:
            path.append(node)
            node = self.parent[node]
        matrix = self._worlds[node]
        for step in reversed(path):
            if step in self._bind_local:
                matrix = matrix @ self._bind_local[step]
            else:
                matrix = matrix @ self._tip.get(self.parent[step], np.eye(4)) @ self.local[step]
            self._worlds[step] = matrix
        return matrix

    def mesh_world(self, node: int) -> Array:
        """(4, 4) matrix of the mesh that the node carries: Blender makes it a child where the node is a bone."""
        return self.world(node) @ self._tip.get(node, np.eye(4))

    def mesh_worlds(self, node: int) -> Array:
        """(n, 4, 4) `mesh_world`, once or for each instance that the node makes of its mesh."""
        document, world = self.document, self.mesh_world(node)
        extensions = document.get(document.items("nodes")[node], "extensions", dict, {})
        attributes = document.get(document.get(extensions, INSTANCES, dict, {}), "attributes", dict, {})
        columns = {
            name: document.accessor(attributes[name], (kind,)).astype(np.float64)
            for name, kind in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3"))
            if name in attributes
        }
        if not columns:
            return world[None]
        counts = {len(column) for column in columns.values()}
        if len(counts) > 1:
            raise AssetError(document.subject, f"has instances with {min(counts)} and {max(counts)} places")
        places = np.tile(np.eye(4), (counts.pop(), 1, 1))
        if "ROTATION" in columns:
            wxyz = columns["ROTATION"][:, [3, 0, 1, 2]]
            length = np.linalg.norm(wxyz, axis=1, keepdims=True)
            places[:, :3, :3] = rotation_matrices(np.where(length > 0, wxyz / length, [1.0, 0.0, 0.0, 0.0]))
        if "SCALE" in columns:
            places[:, :3, :3] *= columns["SCALE"][:, None]
        if "TRANSLATION" in columns:
            places[:, :3, 3] = columns["TRANSLATION"]
        return world @ places

    def skin_matrices(self, skin: int) -> Array:
        """(joints, 4, 4): from a skinned mesh's own space to the scene, one a joint."""
        if not 0 <= skin < len(self.skins):
            raise AssetError(self.document.subject, f"refers to number {skin} of {len(self.skins)} skins")
        joints, inverse_bind = self.skins[skin]
        return np.stack([self.world(joint) for joint in joints]) @ inverse_bind

    def _parents(self, nodes: list[dict[str, Any]]) -> list[int]:
        parents = [ROOT] * len(nodes)
        for i, entry in enumerate(nodes):
            for child in self._numbers(entry, "children"):
                if parents[child] != ROOT or child == i:
                    raise AssetError(self.document.subject, f"has node {child} below two parents")
                parents[child] = i
        state = [0] * len(nodes)  # 0 not seen, 1 on the path being walked, 2 known to end at a root
        for start in range(len(nodes)):
            path = []
            node: int = start
            while node != ROOT and state[node] == 0:
                state[node] = 1
                path.append(node)
                node = parents[node]
            if node != ROOT and state[node] == 1:
                raise AssetError(self.document.subject, "has nodes that contain themselves")
            for seen in path:
                state[seen] = 2
        return parents

    def _numbers(self, entry: dict[str, Any], key: str) -> list[int]:
        """A list of node numbers, each checked."""
        values = self.document.get(entry, key, list, [])
        for value in values:
            self.document.item("nodes", value)
        return [int(value) for value in values]

    def _local(self, node: dict[str, Any]) -> Array:
        if "matrix" in node:
            return self.document.numbers(node, "matrix", tuple(np.eye(4).ravel())).reshape(4, 4).T
        x, y, z, w = self.document.numbers(node, "rotation", (0.0, 0.0, 0.0, 1.0))
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_matrix(w, x, y, z) * self.document.numbers(node, "scale", (1.0, 1.0, 1.0))
        matrix[:3, 3] = self.document.numbers(node, "translation", (0.0, 0.0, 0.0))
        return matrix

    def _skin(self, skin: dict[str, Any]) -> tuple[list[int], Array]:
        joints = self._numbers(skin, "joints")
        if not joints:
            raise AssetError(self.document.subject, "has a skin without joints")
        index = self.document.index(skin, "inverseBindMatrices")
        if index is None:
            return joints, np.tile(np.eye(4), (len(joints), 1, 1))
        matrices = self.document.accessor(index, ("MAT4",)).astype(np.float64)
        if len(matrices) < len(joints) or not np.isfinite(matrices).all():
            raise AssetError(self.document.subject, f"has {len(matrices)} valid bind matrices for {len(joints)} joints")
        return joints, matrices[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)

    def _reachable(self, nodes: list[dict[str, Any]]) -> list[int]:
        """Nodes of the default scene, parents first; all nodes when the file has no scene."""
        scenes = self.document.items("scenes")
        roots = [i for i, parent in enumerate(self.parent) if parent == ROOT]
        if scenes:
            scene = self.document.item("scenes", self.document.index(self.document.json, "scene") or 0)
            roots = self._numbers(scene, "nodes")
        order: list[int] = []
        seen: set[int] = set()
        stack = list(reversed(roots))
        while stack:
            node = stack.pop()
            if node not in seen:
                seen.add(node)
                order.append(node)
                stack.extend(reversed(self._numbers(nodes[node], "children")))
        return order

    def _find_bones(self) -> None:
        """Mark bones as Blender does; give each its bind transform relative to its parent, and its tip."""
        inverse: dict[int, Array] = {ROOT: np.eye(4)}
        bones: dict[int, int] = {}  # bone -> its armature
        for skin, (joints, inverse_bind) in zip(self.document.items("skins"), self.skins, strict=True):
            skeleton = self.document.index(skin, "skeleton")
            armature = self._above([*joints, *([] if skeleton is None else [skeleton])])
            if armature in joints:
                armature = self.parent[armature]
            found: set[int] = {armature, ROOT}
            for joint in joints:
                node: int = joint
                while node not in found:
                    bones[node] = armature
                    found.add(node)
                    node = self.parent[node]
            if "inverseBindMatrices" in skin:
                if skeleton is not None:
                    self.document.item("nodes", skeleton)
                    inverse.setdefault(self.parent[skeleton] if skeleton in joints else skeleton, np.eye(4))
                inverse.update(zip(joints, inverse_bind, strict=True))
        for bone in bones:
            parent, matrix = self.parent[bone], self.local[bone]
            if bone in inverse and parent in inverse and abs(np.linalg.det(inverse[bone])) > 1e-30:
                matrix = inverse[parent] @ np.linalg.inv(inverse[bone])
            self._bind_local[bone] = _without_scale(matrix)
        lengths: dict[int, float] = {}
        children: dict[int, list[int]] = {}
        for bone in bones:
            children.setdefault(self.parent[bone], []).append(bone)
        for bone in self._parents_first(bones):
            length = lengths[bone] = self._bone_length(bone, children.get(bone, []), lengths)
            armature = bones[bone]
            scale = 1.0 if armature == ROOT else float(np.linalg.norm(self.local[armature][:3, :3], axis=0).max())
            self._tip[bone] = np.eye(4)
            self._tip[bone][1, 3] = length / scale - length if scale > 0 else 0.0

    def _bone_length(self, bone: int, children: list[int], known: dict[int, float]) -> float:
        """The length Blender gives a bone: to its nearest child, else that of its parent, else its own distance."""
        distances = [float(np.linalg.norm(self._bind_local[b][:3, 3])) for b in children]
        distances = [d for d in distances if d > SHORTEST_BONE]
        own = float(np.linalg.norm(self._bind_local[bone][:3, 3]))
        if distances:
            return min(distances)
        if self.parent[bone] in known:
            return known[self.parent[bone]]
        return own if own > SHORTEST_BONE else 1.0

    def _above(self, nodes: list[int]) -> int:
        """The deepest node that is or contains all of `nodes`; every node is passed once."""
        top = nodes[0]
        below = {top}
        for start in nodes[1:]:
            node, path = start, []
            while node not in below and node != ROOT:
                path.append(node)
                node = self.parent[node]
            if node not in below:  # `start` is elsewhere
                passed = {*path, ROOT}
                while top not in passed:
                    top = self.parent[top]
                    below.add(top)
                if top == ROOT:
                    return ROOT
                path = path[: path.index(top)]
            below.update(path)
        return top

    def _parents_first(self, bones: Iterable[int]) -> list[int]:
        """`bones` by their depth."""
        depth = {ROOT: 0}
        for bone in bones:
            path = []
            node = bone
            while node not in depth:
                path.append(node)
                node = self.parent[node]
            for passed in reversed(path):
                depth[passed] = depth[self.parent[passed]] + 1
        return sorted(bones, key=depth.__getitem__)


def rotation_matrix(w: float, x: float, y: float, z: float) -> Array:
    """(3, 3) matrix of a quaternion; the identity where its length is 0."""
    length = float(np.sqrt(w * w + x * x + y * y + z * z))
    if length == 0.0:
        return np.eye(3)
    w, x, y, z = w / length, x / length, y / length, z / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _without_scale(matrix: Array) -> Array:
    """The rigid part of an affine matrix: columns orthogonalised one after the other, mirrors turned around."""
    result = matrix.copy()
    columns = matrix[:3, :3] * (-1.0 if np.linalg.det(matrix[:3, :3]) < 0 else 1.0)
    basis: list[Array] = []
    for column in columns.T:
        rest = column - sum((np.dot(column, b) * b for b in basis), np.zeros(3))
        length = np.linalg.norm(rest)
        basis.append(rest / length if length > 1e-20 else np.eye(3)[len(basis)])
    result[:3, :3] = np.stack(basis, axis=1)
    return result
