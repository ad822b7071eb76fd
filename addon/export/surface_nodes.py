"""A material's shaders: what its surface reflects, gives off and lets through."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np

from ..bakes.node_trees import COLOURS, SHADERS, leaf_of
from .bsdfs import Bsdf, MixingWalker, Part, Surface
from .layers import LayerRef
from .node_math import conductor, hair_colour, melanin_colour, strand_albedo
from .normal_nodes import DetailRef
from .socket_value import SocketValue, constant, once, uniform
from .sockets import SocketRef, hollow, surface_of

#: Least alpha of a surface that gives off light and lets all light pass, which no alpha says.
_LEAST_ADDED = 0.25
#: What BSDFs have that is not rendered, if its input is not zero.
_UNRENDERED = {"Subsurface Weight": "subsurface scattering (it is diffuse)", "Thin Film Thickness": "thin film"}
#: Channels that do not matter where others are zero.
_BELONGS = {
    "anisotropy_rotation": "anisotropy",
    **dict.fromkeys(("coat_roughness", "coat_ior", "coat_tint"), "coat"),
    **dict.fromkeys(("sheen_roughness", "sheen_tint"), "sheen"),
}
#: Channels that metals have not.
_DIELECTRIC = ("ior", "specular_level", "transmission", "diffuse_roughness")
#: Channels that are no part of a BSDF.
_APART = ("emission", "alpha")


class SurfaceWalker(MixingWalker):
    """Evaluates a material on a mesh."""

    def surface(self) -> Surface | None:
        """The material's surface; None where it is invisible."""
        material = self.material
        # From Blender 5.0 on every material has nodes, and the switch is deprecated.
        if material.node_tree is None or (bpy.app.version < (5, 0, 0) and not material.use_nodes):
            return _plain(uniform(material.diffuse_color[:3]), uniform(material.roughness), uniform(material.metallic))
        ref = surface_of(material.node_tree)
        origin = None if ref is None else ref.origin()
        linked = origin is not None and origin.socket.is_output
        output = ref and ref.node
        if output:
            self.name_lost_groups(material.node_tree, output)
        if output and output.inputs["Displacement"].is_linked:
            self.note(output, "displacement is not rendered")
        if output and output.inputs["Volume"].is_linked:
            self.note(output, "the volume is not rendered")
            if not linked:
                return None
        if ref is None or origin is None or not linked:
            self.report("has no surface, which is black in Blender; its viewport colour is used")
            return _plain(uniform(material.diffuse_color[:3]), uniform(material.roughness))
        if origin.node.type == "HOLDOUT":
            return Surface()  # black, where it is not cut out: see `holdouts`
        surface = self.shader(ref)
        return None if surface.alpha.black else self.settled(output, surface)

    # Shaders

    @once(lambda self: _plain(uniform(self.unknown)))
    def shader(self, ref: SocketRef) -> Surface:
        """The surface of a shader input."""
        origin = self.origin(ref)
        if not origin.socket.is_output:
            return Surface()
        evaluate = getattr(self, f"shader_{origin.node.type.lower()}", None)
        return evaluate(origin) if evaluate is not None else self.other_shader(origin)

    def shader_bsdf_principled(self, output: SocketRef) -> Surface:
        node = output.node
        alpha = _unit(self.number(output.input("Alpha")))
        strength = self.number(output.input("Emission Strength"))
        emission = uniform(0)
        if not strength.black:
            emission = self.combine(node, np.multiply, self.colour(output.input("Emission Color")), strength)
        details = self.normal_of(output)
        bsdf = self.bsdf(output, "principled")
        switches = {name for name, on in (("thin_walled", self.is_thin(output)),) if on}
        if "coat" in bsdf.values and self.is_coat_detailed(output, details):
            switches.add("coat_details")
        return Surface((Part(replace(bsdf, switches=bsdf.switches | switches)),), emission, alpha, details)

    def bsdf(self, output: SocketRef, kind: str) -> Bsdf:
        """A BSDF of a kind, with the inputs of its node."""
        node = output.node
        values: dict[str, SocketValue] = {}
        channels = SHADERS[node.type]
        for channel, source in channels.items():
            owner = _BELONGS.get(channel)
            if channel in _APART or (owner in channels and owner not in values):
                continue
            if channel in _DIELECTRIC and _is_one(values.get("metallic")):
                continue
            if not isinstance(source, tuple):
                values[channel] = uniform(source)
            elif source[0] in node.inputs:
                ref = output.input(source[0])
                value = self.colour(ref) if channel in COLOURS else self.number(ref)
                if channel not in _BELONGS.values() or not value.black:
                    values[channel] = value
        self.warn_unrendered(output, values)
        tangent = self.tangent(output) if "anisotropy" in values else None
        switches = {"multiscatter"} if getattr(node, "distribution", "") == "MULTI_GGX" else set()
        return Bsdf(kind, values, frozenset(switches), tangent, (leaf_of(node),))

    def warn_unrendered(self, output: SocketRef, values: dict[str, SocketValue]) -> None:
        """One warning for all that a BSDF does and that is not rendered."""
        node = output.node
        found = [text for name, text in _UNRENDERED.items() if name in node.inputs and _used(output.input(name))]
        rough = values.get("roughness", uniform(1))
        shape = getattr(node, "distribution", "")
        if shape in ("BECKMANN", "ASHIKHMIN_SHIRLEY") and not rough.black:
            found.append(f"{shape.replace('_', '-').title()} distribution (GGX is used)")
        elif shape == "ASHIKHMIN":
            found.append("Ashikhmin distribution (Microfiber is used)")
        if found:
            self.note(node, f"not rendered: {', '.join(found)}")

    def is_thin(self, output: SocketRef) -> bool:
        """Whether a Principled BSDF is a sheet; Blender has that from 5.2 on."""
        if "Thin Wall" not in output.node.inputs:
            return False
        origin = output.input("Thin Wall").origin()
        if origin.socket.is_output:
            self.note(output.node, "Thin Wall cannot vary; it is off")
            return False
        return bool(constant(origin.socket)[0])

    def is_coat_detailed(self, output: SocketRef, details: tuple[DetailRef, ...]) -> bool:
        """Whether the coat has the normal of what is below, and not the smooth one."""
        own = self.normal(output.input("Coat Normal"))
        if own and not (len(own) == len(details) and all(map(DetailRef.same, own, details))):
            self.note(output.node, "the coat has a normal of its own; that of the surface below is used")
        return bool(own)

    def tangent(self, output: SocketRef) -> LayerRef:
        """What highlights follow."""
        origin = output.input("Tangent").origin()
        node = origin.node
        if origin.socket.is_output:
            if node.type == "TANGENT":
                return (
                    LayerRef("uv", node.uv_map) if node.direction_type == "UV_MAP" else LayerRef("tangent", node.axis)
                )
            if not (node.type == "NEW_GEOMETRY" and origin.socket.name == "Tangent"):
                self.warn(node, f"{node.bl_label} is not supported for tangents; they run around the Z axis")
        return LayerRef("tangent", "Z")

    def single(self, output: SocketRef, kind: str) -> Surface:
        return Surface((Part(self.bsdf(output, kind)),), details=self.normal_of(output))

    def shader_bsdf_diffuse(self, output: SocketRef) -> Surface:
        return self.single(output, "diffuse")

    def shader_bsdf_glossy(self, output: SocketRef) -> Surface:
        return self.single(output, "glossy")

    def shader_bsdf_glass(self, output: SocketRef) -> Surface:
        return self.single(output, "glass")

    def shader_bsdf_refraction(self, output: SocketRef) -> Surface:
        return self.single(output, "refraction")

    def shader_bsdf_translucent(self, output: SocketRef) -> Surface:
        return self.single(output, "translucent")

    def shader_bsdf_sheen(self, output: SocketRef) -> Surface:
        return self.single(output, "sheen")

    def shader_subsurface_scattering(self, output: SocketRef) -> Surface:
        self.note(output.node, "not rendered: subsurface scattering (it is diffuse)")
        return self.single(output, "diffuse")

    def shader_bsdf_metallic(self, output: SocketRef) -> Surface:
        surface = self.single(output, "principled")
        node = output.node
        if node.fresnel_type == "F82":
            return surface
        self.note(node, "its physical Fresnel is approximated by that of F82")
        part = surface.parts[0]
        base, edge = conductor(self.fixed(output.input("IOR")), self.fixed(output.input("Extinction")))
        values = part.bsdf.values | {"base_colour": uniform(base), "specular_tint": uniform(edge)}
        return replace(surface, parts=(replace(part, bsdf=replace(part.bsdf, values=values)),))

    def shader_bsdf_hair_principled(self, output: SocketRef) -> Surface:
        """A surface of its colour, which is that of many hairs together."""
        node = output.node
        surface, kind = self.other_shader(output), node.parametrization
        part = surface.parts[0]
        radial = output.input("Radial Roughness") if getattr(node, "model", "CHIANG") == "CHIANG" else None
        rough = uniform(0.3) if radial is None else self.number(radial)
        if kind == "COLOR":
            base = part.bsdf.values["base_colour"]
        elif kind == "ABSORPTION":
            base = self.combine(node, hair_colour, self.colour(output.input("Absorption Coefficient")), rough)
        else:
            inputs = [self.number(output.input(name)) for name in ("Melanin", "Melanin Redness")]
            base = self.combine(node, melanin_colour, *inputs, self.colour(output.input("Tint")), rough)
        if not isinstance(self.mesh, bpy.types.Mesh):
            base = self.combine(node, strand_albedo, base)
        bsdf = replace(part.bsdf, values=part.bsdf.values | {"base_colour": base})
        return replace(surface, parts=(replace(part, bsdf=bsdf),))

    def shader_emission(self, output: SocketRef) -> Surface:
        operands = self.colour(output.input("Color")), self.number(output.input("Strength"))
        return Surface(emission=self.combine(output.node, np.multiply, *operands))

    shader_background = shader_emission

    def shader_bsdf_transparent(self, output: SocketRef) -> Surface:
        colour = self.fixed(output.input("Color"))
        if np.ptp(colour) > 0.01 or colour.mean() < 0.99:
            self.warn(output.node, "coloured transparency is not rendered; it is clear")
        return Surface(alpha=uniform(0))

    def shader_holdout(self, output: SocketRef) -> Surface:
        self.report(
            "its Holdout is mixed with other shaders, and black there. Make it the whole surface of a material, or use "
            "Object Properties > Visibility > Holdout"
        )
        return Surface()

    def shader_mix_shader(self, output: SocketRef) -> Surface:
        factor = output.input(0).origin()
        first, second = self.shader(output.input(1)), self.shader(output.input(2))
        if factor.socket.is_output and factor.node.type == "LIGHT_PATH":
            self.warn(output.node, f'"{factor.socket.name}" is not evaluated per ray; the first shader is used')
            return first
        return self.joined(output.node, first, second, _unit(self.number(output.input(0))))

    def joined(self, node: bpy.types.Node, first: Surface, second: Surface, share: SocketValue) -> Surface:
        """`share` of the second surface, the rest of the first, with what light passes of either."""
        if second.alpha.black:
            return replace(first, alpha=self.combine(node, lambda f, a: (1 - f) * a, share, first.alpha))
        if first.alpha.black:
            return replace(second, alpha=self.combine(node, np.multiply, second.alpha, share))
        a, b = first.alpha, second.alpha
        if a.texture == b.texture and (a.colour == b.colour).all():
            return replace(self.mixed(node, first, second, share), alpha=a)
        alpha = self.combine(node, lambda f, x, y: x + f * (y - x), share, a, b)
        if any(value.texture is not None for value in (a, b, share)):
            self.warn(node, "both shaders let light pass, one more than the other; what is there is mixed as if alike")
        else:
            share = replace(share, colour=b.colour * share.colour / np.maximum(alpha.colour, 1e-9))
        return replace(self.mixed(node, first, second, share), alpha=alpha)

    def shader_add_shader(self, output: SocketRef) -> Surface:
        node, first, second = output.node, self.shader(output.input(0)), self.shader(output.input(1))
        if first.alpha.black and second.alpha.black:
            return first
        a, b = (float(self.flat(node, surface.alpha)[0]) for surface in (first, second))
        if a + b <= 0:  # of images that are clear everywhere
            return replace(first, alpha=uniform(0))
        alpha = max(1 - (2 - a - b), _LEAST_ADDED)
        if a + b < 2:
            self.warn(node, f"light added to what passes: the surface hides {alpha:.0%} of what is behind it")
        return replace(self.added(node, first, second, a / alpha, b / alpha), alpha=uniform(alpha))

    def other_shader(self, output: SocketRef) -> Surface:
        """The nearest to a shader that is not known: its colour, scattered."""
        node = output.node
        problem = hollow(node) if node.type == "GROUP" else f"{node.bl_label} is not supported"
        self.note(node, f"{problem}; a surface of its colour is used")
        colours = [s for s in node.inputs if s.type == "RGBA" and s.enabled]
        base = self.colour(SocketRef(colours[0], output.groups)) if colours else uniform(0.8)
        rough = output.input("Roughness") if "Roughness" in node.inputs else None
        rough_value = self.number(rough) if rough else uniform(1)
        return replace(_plain(base, rough_value), details=self.normal_of(output))


def _plain(base: SocketValue, roughness: SocketValue | None = None, metallic: SocketValue | None = None) -> Surface:
    """A Principled BSDF of which no more is known."""
    values = {"base_colour": base, "roughness": roughness or uniform(1), "metallic": metallic or uniform(0)}
    return Surface((Part(Bsdf("principled", values)),))


def _is_one(value: SocketValue | None) -> bool:
    return value is not None and value.texture is None and bool((value.colour >= 1).all())


def _unit(value: SocketValue) -> SocketValue:
    """Within [0, 1]; what a texture says is so where it is looked up."""
    if value.texture is not None:
        return value
    return replace(value, colour=np.clip(np.nan_to_num(value.colour, nan=1.0), 0, 1))


def _used(ref: SocketRef) -> bool:
    """Whether a number input is linked or not zero."""
    origin = ref.origin()
    return origin.socket.is_output or abs(constant(origin.socket)[0]) > 1e-4
