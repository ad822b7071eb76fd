"""A material's nodes -> frame.Material: colours and numbers, each times an image where there is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import bpy
import numpy as np

from ...drgs_blender.core.frame import Image, Material, Texture
from . import images
from .node_math import reflectance
from .nodes import Paint, Walker, constant, euler, once, plain, vector_rotate
from .sockets import Place, surface_of
from .texture_refs import Channel, TextureRef

Warn = Callable[[str], None]
Array = np.ndarray

#: Of the Principled BSDF: inputs that must be zero, and what they are called in the warning.
_LOBES = {
    "Subsurface Weight": "subsurface",
    "Transmission Weight": "transmission",
    "Coat Weight": "coat",
    "Sheen Weight": "sheen",
    "Anisotropic": "anisotropy",
    "Thin Film Thickness": "thin film",
    "Diffuse Roughness": "diffuse roughness",
}


@dataclass(slots=True)
class Surface:
    """What a shader does: light it reflects and gives off, the share it scatters, the share it lets through.

    ``base`` is already times the share that is scattered.
    """

    base: Paint = field(default_factory=lambda: plain(0))
    roughness: Paint = field(default_factory=lambda: plain(1))
    metallic: Paint = field(default_factory=lambda: plain(0))
    emission: Paint = field(default_factory=lambda: plain(0))
    scattered: float = 0.0
    clear: float = 0.0


@dataclass(frozen=True, slots=True)
class Look:
    """A material as it is exported; ``material`` None is one that nothing is seen of. ``uv_map`` "" is the active."""

    material: Material | None
    uv_map: str | None = None


DEFAULT_MATERIAL = Material("Default")
DEFAULT = Look(DEFAULT_MATERIAL)


class Materials:
    """All materials of one export, and the images they use. `override` takes the place of every one."""

    def __init__(self, warn: Warn, override: bpy.types.Material | None = None) -> None:
        self._warn, self.override = warn, override
        self._known: dict[tuple[int, int], Look] = {}
        self.images: dict[str, Image] = {}

    def slots(self, obj: bpy.types.Object) -> list[bpy.types.Material | None]:
        """Materials in the slots of an evaluated object."""
        own = [slot.material for slot in obj.material_slots]
        return own if self.override is None else [self.override] * max(len(own), 1)

    def look(self, material: bpy.types.Material | None, mesh: bpy.types.Mesh) -> Look:
        """How an evaluated material shows on an evaluated mesh."""
        if material is None:
            return DEFAULT
        for key in ((material.as_pointer(), 0), (material.as_pointer(), mesh.as_pointer())):
            if key in self._known:
                return self._known[key]
        tree = _Tree(material, mesh, self._warn)
        look = self._look(tree)
        self._known[material.as_pointer(), mesh.as_pointer() if tree.asks_mesh else 0] = look
        return look

    def _look(self, tree: _Tree) -> Look:
        material = tree.material
        surface = tree.surface()
        if surface is None:
            return Look(None)
        # A surface is there or not; one that is there scatters as if it were there entirely.
        base = surface.base.times(1 / (1 - surface.clear)) if surface.clear < 1 else surface.base
        paints = {
            "base_colour": base,
            "roughness": surface.roughness,
            "metallic": surface.metallic,
            "emission": surface.emission,
        }
        values: dict[str, Any] = {}
        maps: list[str] = []
        for name, paint in paints.items():
            picture = paint.texture
            values[name] = _usable(tree, name, paint, getattr(DEFAULT_MATERIAL, name))
            if isinstance(picture, TextureRef):
                values[f"{name}_texture"] = self._texture(picture)
                maps.append(picture.uv_map)
        if len(set(maps)) > 1:
            names = ", ".join(name or "the active one" for name in dict.fromkeys(maps))
            self._warn(f'Material "{material.name}": of its UV maps ({names}) only the first is used')
        return Look(Material(material.name, **values), maps[0] if maps else None)

    def _texture(self, picture: TextureRef) -> Texture:
        exported = picture.export(self._warn)
        self.images[exported.name] = exported
        return picture.texture(exported.name)


def _usable(tree: _Tree, name: str, paint: Paint, default: tuple[float, float, float] | float) -> object:
    """The number or colour of a field of frame.Material, finite and where it can be."""
    colour = paint.colour
    if not np.isfinite(colour).all():
        tree.say(f"its {name.replace('_', ' ')} is not finite; Blender's default is used. Check its drivers")
        colour = np.broadcast_to(default, 3)
    colour = np.maximum(colour, 0)
    if name in ("roughness", "metallic") and paint.texture is None:
        colour = np.minimum(colour, 1)
    return tuple(map(float, colour)) if name in ("base_colour", "emission") else float(colour[0])


class _Tree(Walker):
    """Evaluates the nodes of a material on a mesh."""

    def __init__(self, material: bpy.types.Material, mesh: bpy.types.Mesh, warn: Warn) -> None:
        super().__init__(f'Material "{material.name}"', warn)
        self.material, self.mesh = material, mesh
        self.asks_mesh = False

    def say(self, problem: str) -> None:
        """Warn of the material as a whole."""
        self._warn(f"{self.owner}: {problem}")

    def surface(self) -> Surface | None:
        """What the material's surface does; None where nothing is seen of it."""
        material = self.material
        # From Blender 5.0 on every material has nodes, and the switch is deprecated.
        if material.node_tree is None or (bpy.app.version < (5, 0, 0) and not material.use_nodes):
            base, rough, metal = material.diffuse_color[:3], material.roughness, material.metallic
            return Surface(plain(base), plain(rough), plain(metal), scattered=1)
        place = surface_of(material.node_tree)
        linked = place is not None and place.origin().socket.is_output
        output = place and place.node
        if output and output.inputs["Displacement"].is_linked:
            self.warn(output, "displacement is not rendered")
        if output and output.inputs["Volume"].is_linked:
            self.warn(output, "the volume is not rendered")
            if not linked:
                return None
        if not linked:
            self.say("has no surface, which is black in Blender; its viewport colour is used")
            return Surface(plain(material.diffuse_color[:3]), plain(material.roughness), scattered=1)
        surface = self.shader(place)
        if 0 < surface.clear < 1:
            state = "left out" if surface.clear > 0.5 else "opaque"
            self.say(f"is {surface.clear:.0%} transparent, which is not rendered; it is {state}")
        return None if surface.clear > 0.5 and surface.emission.black else surface

    # Textures

    def mean(self, texture: Any) -> Array:
        return texture.mean(self._warn)

    def channel(self, texture: Any, name: str) -> TextureRef:
        return texture.only(cast(Channel, name))

    def curved(self, texture: Any, function: Callable[[Array], Array]) -> Paint | None:
        found = texture.curved(function, self._warn)
        return None if found is None else Paint(np.full(3, found[1]), found[0])

    def node_tex_image(self, output: Place) -> Paint:
        node, image = output.node, output.node.image
        straight = node.outputs["Alpha"].is_linked
        if image is None or images.export_image(image, straight, self._warn) is None:
            name = "has no image" if image is None else f'image "{image.name}" cannot be read'
            self.warn(node, f"{name}; as in Cycles it is magenta. Choose another, or find its file")
            return plain(1) if output.socket.name == "Alpha" else Paint(np.array(images.MISSING))
        if node.projection != "FLAT":
            self.warn(node, f"the {node.projection.title()} projection is not supported; the UV map is used")
        if node.interpolation not in ("Linear", "Closest"):
            self.warn(node, f"{node.interpolation} interpolation is read as Linear")
        matrix, uv_map = self.coordinates(output.input("Vector"))
        return Paint(
            np.ones(3),
            TextureRef(
                image,
                straight,
                "a" if output.socket.name == "Alpha" else "rgb",
                uv_map,
                tuple(map(tuple, matrix.tolist())),
                "closest" if node.interpolation == "Closest" else "linear",
                node.extension.lower(),
            ),
        )

    def node_tex_environment(self, output: Place) -> Paint:
        node = output.node
        if node.image is not None and (picture := images.export_image(node.image, False, self._warn)) is not None:
            self.warn(node, "an Environment Texture is not supported on surfaces; its mean colour is used")
            return Paint(images.mean_colour(picture)[:3])
        return self.nearest(output, output)

    def node_vertex_color(self, output: Place) -> Paint:
        return self.attribute(output, output.node.layer_name)

    def node_attribute(self, output: Place) -> Paint:
        node = output.node
        if node.attribute_type != "GEOMETRY":
            return self.nearest(output, output)
        return self.attribute(output, node.attribute_name)

    def attribute(self, output: Place, name: str) -> Paint:
        """The mean of an attribute of the mesh; "" is the colour attribute that renders."""
        self.asks_mesh = True
        if name == "" and len(self.mesh.color_attributes):
            name = self.mesh.color_attributes[max(self.mesh.color_attributes.render_color_index, 0)].name
        values = _attribute_values(self.mesh, name)
        if values is None:
            self.warn(output.node, f'mesh "{self.mesh.name}" has no values "{name}"; a plain grey is used')
            return plain(self.unknown)
        self.warn(output.node, f'values on the mesh are not rendered; the mean of "{name}" is used')
        mean = values.mean(axis=0, dtype=np.float64)
        if output.socket.name == "Alpha":
            return plain(mean[3] if len(mean) == 4 else 1)
        return plain(mean[:3].mean()) if output.socket.identifier == "Fac" else plain(mean[:3])

    def node_ambient_occlusion(self, output: Place) -> Paint:
        if output.socket.type == "RGBA":
            return self.nearest(output, output)
        self.warn(output.node, "Ambient Occlusion is not supported; 1 is used")
        return plain(1)

    def node_fresnel(self, output: Place) -> Paint:
        ior = self.value(output.input("IOR"))
        self.warn(output.node, "it cannot depend on the direction; the value when seen from the front is used")
        return plain(reflectance(ior))

    def node_layer_weight(self, output: Place) -> Paint:
        blend = np.clip(self.value(output.input("Blend")), 0, 0.99999)
        self.warn(output.node, "it cannot depend on the direction; the value when seen from the front is used")
        if output.socket.name == "Facing":
            return plain(0)
        return plain(reflectance(1 / (1 - blend)))

    # Coordinates

    def coordinates(self, place: Place) -> tuple[Array, str]:
        """(4, 4) from UV coordinates to those of a texture, and the UV map's name ("" is the active one)."""
        origin = place.origin()
        if not origin.socket.is_output:
            return np.eye(4), ""
        node, name = origin.node, origin.socket.name
        if node.type == "UVMAP":
            return np.eye(4), node.uv_map
        if node.type == "TEX_COORD":
            if name != "UV":
                self.warn(node, f"{name} coordinates are not supported; the UV map is used")
            return np.eye(4), ""
        if node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY":
            return np.eye(4), node.attribute_name
        if node.type == "MAPPING" and node.vector_type != "NORMAL":
            matrix, uv_map = self.coordinates(origin.input("Vector"))
            return self.mapping(origin) @ matrix, uv_map
        if node.type == "VECTOR_ROTATE":
            matrix, uv_map = self.coordinates(origin.input("Vector"))
            centre = np.append(self.fixed(origin.input("Center")), 1)
            turn = np.eye(4)
            turn[:3, :3] = vector_rotate(self, origin)
            turn[:3, 3] = (centre - turn @ centre)[:3]
            return turn @ matrix, uv_map
        if node.type == "VECT_MATH" and node.operation in ("ADD", "SUBTRACT", "MULTIPLY", "SCALE"):
            matrix, uv_map = self.coordinates(origin.input(0))
            change = np.eye(4)
            if node.operation == "SCALE":
                change[:3, :3] *= self.value(origin.input("Scale"))
            elif node.operation == "MULTIPLY":
                change[:3, :3] = np.diag(self.fixed(origin.input(1)))
            else:
                change[:3, 3] = self.fixed(origin.input(1)) * (1 if node.operation == "ADD" else -1)
            return change @ matrix, uv_map
        inputs = [s for s in node.inputs if s.type == "VECTOR" and s.is_linked]
        self.warn(node, f"{node.bl_label} is not supported between UV map and image, and left out")
        return self.coordinates(Place(inputs[0], origin.groups)) if inputs else (np.eye(4), "")

    def mapping(self, output: Place) -> Array:
        """(4, 4) of a Mapping node."""
        node = output.node
        matrix = np.eye(4)
        matrix[:3, :3] = euler(self.fixed(output.input("Rotation"))) * self.fixed(output.input("Scale"))
        if node.vector_type == "VECTOR":
            return matrix
        matrix[:3, 3] = self.fixed(output.input("Location"))
        if node.vector_type == "POINT":
            return matrix
        if abs(np.linalg.det(matrix)) < 1e-12:
            self.warn(node, "a Scale of 0 cannot be undone; it is left out")
            return np.eye(4)
        return np.linalg.inv(matrix)

    # Shaders

    @once(lambda self: Surface(plain(self.unknown), scattered=1))
    def shader(self, place: Place) -> Surface:
        """What a shader input does."""
        origin = place.origin()
        if not origin.socket.is_output:
            return Surface()
        evaluate = getattr(self, f"shader_{origin.node.type.lower()}", None)
        return evaluate(origin) if evaluate is not None else self.other_shader(origin)

    def shader_bsdf_principled(self, output: Place) -> Surface:
        node = output.node
        alpha = float(np.clip(self.opacity(output.input("Alpha")), 0, 1))
        strength = self.number(output.input("Emission Strength"))
        emission = plain(0)
        if not strength.black:
            emission = self.combine(node, np.multiply, self.colour(output.input("Emission Color")), strength)
        lacking = [said for name, said in _LOBES.items() if name in node.inputs and _used(output.input(name))]
        if not 0.03 < self.reflectance(output) < 0.05:
            lacking.append("specular other than that of IOR 1.5")
        self.complain(output, lacking)
        return Surface(
            self.colour(output.input("Base Color")).times(alpha),
            self.number(output.input("Roughness")),
            self.number(output.input("Metallic")),
            emission.times(alpha),
            scattered=alpha,
            clear=1 - alpha,
        )

    def reflectance(self, output: Place) -> float:
        """Of a Principled BSDF, seen from the front; that of IOR 1.5 where it varies."""
        ior, level = output.input("IOR").origin().socket, output.input("Specular IOR Level").origin().socket
        if ior.is_output or level.is_output:
            return float("nan")
        return reflectance(ior.default_value) * 2 * level.default_value

    def opacity(self, place: Place) -> float:
        """A constant alpha; where it varies, the surface is there."""
        alpha, origin = self.number(place), place.origin()
        if alpha.texture is None:
            return float(alpha.colour[0])
        self.warn(origin.node, "transparency that varies over the surface is not rendered; it is opaque")
        return 1.0

    def complain(self, output: Place, lacking: list[str]) -> None:
        """One warning for all that a shader node does beyond the supported."""
        normal = output.node.inputs.get("Normal")
        if normal is not None and normal.is_linked:
            lacking = [*lacking, "its normal or bump map"]
        if lacking:
            self.warn(output.node, f"not rendered: {', '.join(lacking)}")

    def shader_bsdf_diffuse(self, output: Place) -> Surface:
        self.complain(output, [])
        return Surface(self.colour(output.input("Color")), scattered=1)

    def shader_bsdf_glossy(self, output: Place) -> Surface:
        self.complain(output, ["anisotropy"] if _used(output.input("Anisotropy")) else [])
        base, roughness = self.colour(output.input("Color")), self.number(output.input("Roughness"))
        return Surface(base, roughness, plain(1), scattered=1)

    def shader_bsdf_metallic(self, output: Place) -> Surface:
        node = output.node
        lacking = ["anisotropy"] if _used(output.input("Anisotropy")) else []
        if node.fresnel_type != "F82":
            lacking.append("physical conductor (its Base Color is used)")
        self.complain(output, lacking)
        base, roughness = self.colour(output.inputs()["Base Color"]), self.number(output.input("Roughness"))
        return Surface(base, roughness, plain(1), scattered=1)

    def shader_emission(self, output: Place) -> Surface:
        operands = self.colour(output.input("Color")), self.number(output.input("Strength"))
        return Surface(emission=self.combine(output.node, np.multiply, *operands))

    shader_background = shader_emission

    def shader_bsdf_transparent(self, output: Place) -> Surface:
        colour = self.fixed(output.input("Color"))
        if np.ptp(colour) > 0.01 or colour.mean() < 0.99:
            self.warn(output.node, "coloured transparency is not rendered; it is clear")
        return Surface(clear=1)

    def shader_mix_shader(self, output: Place) -> Surface:
        factor = output.input(0).origin()
        first, second = self.shader(output.input(1)), self.shader(output.input(2))
        if factor.socket.is_output and factor.node.type == "LIGHT_PATH":
            self.warn(output.node, f'"{factor.socket.name}" cannot be told apart; the first shader is used')
            return first
        share = self.number(output.input(0))
        if share.texture is None:
            share = plain(np.clip(share.colour, 0, 1))
        elif first.clear or second.clear:
            self.warn(output.node, "transparency that varies over the surface is not rendered; it is opaque")
            return min(first, second, key=lambda surface: surface.clear)
        return self.mixed(output.node, first, second, share)

    def shader_add_shader(self, output: Place) -> Surface:
        node, first, second = output.node, self.shader(output.input(0)), self.shader(output.input(1))
        half = self.mixed(node, first, second, plain(0.5))
        return replace(
            half,
            base=half.base.times(2),
            emission=half.emission.times(2),
            scattered=min(1.0, first.scattered + second.scattered),
            clear=min(1.0, first.clear + second.clear),
        )

    def mixed(self, node: bpy.types.Node, first: Surface, second: Surface, share: Paint) -> Surface:
        """`share` of the second surface, the rest of the first; of roughness and metallic by what each scatters."""

        def mix(f: Array, a: Array, b: Array) -> Array:
            return a * (1 - f) + b * f

        mean = float(share.colour[0] * (1 if share.texture is None else self.mean(share.texture)[0]))
        weights = (1 - mean) * first.scattered, mean * second.scattered
        if first.scattered == second.scattered:
            rough_share = share
        else:
            rough_share = plain(weights[1] / max(sum(weights), 1e-9))
        return Surface(
            self.combine(node, mix, share, first.base, second.base),
            self.combine(node, mix, rough_share, first.roughness, second.roughness),
            self.combine(node, mix, rough_share, first.metallic, second.metallic),
            self.combine(node, mix, share, first.emission, second.emission),
            scattered=sum(weights),
            clear=(1 - mean) * first.clear + mean * second.clear,
        )

    def other_shader(self, output: Place) -> Surface:
        """The nearest to a shader that is not known: its colour, scattered."""
        node = output.node
        self.warn(node, f"{node.bl_label} is not supported; a surface of its colour is used")
        colours = [s for s in node.inputs if s.type == "RGBA" and s.enabled]
        base = self.colour(Place(colours[0], output.groups)) if colours else plain(0.8)
        rough = output.input("Roughness") if "Roughness" in node.inputs else None
        return Surface(base, self.number(rough) if rough else plain(1), scattered=1)


def _used(place: Place) -> bool:
    """Whether a number input is linked or not zero."""
    origin = place.origin()
    return origin.socket.is_output or abs(constant(origin.socket)[0]) > 1e-4


def _attribute_values(mesh: bpy.types.Mesh, name: str) -> Array | None:
    """(n, 1), (n, 2), (n, 3) or (n, 4) float32 values of a mesh's attribute, colours linear; None without any."""
    attribute = mesh.attributes.get(name)
    kinds = {
        "FLOAT_COLOR": ("color", 4),
        "BYTE_COLOR": ("color", 4),
        "FLOAT_VECTOR": ("vector", 3),
        "FLOAT2": ("vector", 2),
        "FLOAT": ("value", 1),
    }
    if attribute is None or attribute.data_type not in kinds or len(attribute.data) == 0:
        return None
    prop, width = kinds[attribute.data_type]
    values = np.empty((len(attribute.data), width), np.float32)
    attribute.data.foreach_get(prop, values.ravel())
    return values
