"""A material's shaders: what its surface reflects, gives off and lets through."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from .node_math import reflectance
from .normal_nodes import DetailRef, NormalWalker
from .socket_value import Array, SocketValue, constant, once, uniform
from .sockets import SocketRef, surface_of

#: Least alpha of a surface that gives off light and lets all light pass, which no alpha says.
_LEAST_ADDED = 0.25
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
    """Result of a shader.

    Attributes
    ----------
    base, emission : light reflected and given off by the part that is there; ``base`` is times `scattered`
    scattered : share of that part that is scattered
    alpha : share that is there; light passes the rest
    """

    base: SocketValue = field(default_factory=lambda: uniform(0))
    roughness: SocketValue = field(default_factory=lambda: uniform(1))
    metallic: SocketValue = field(default_factory=lambda: uniform(0))
    emission: SocketValue = field(default_factory=lambda: uniform(0))
    scattered: float = 0.0
    alpha: SocketValue = field(default_factory=lambda: uniform(1))
    details: tuple[DetailRef, ...] = ()


class SurfaceWalker(NormalWalker):
    """Evaluates a material on a mesh."""

    def surface(self) -> Surface | None:
        """The material's surface; None where it is invisible."""
        material = self.material
        # From Blender 5.0 on every material has nodes, and the switch is deprecated.
        if material.node_tree is None or (bpy.app.version < (5, 0, 0) and not material.use_nodes):
            base, rough, metal = material.diffuse_color[:3], material.roughness, material.metallic
            return Surface(uniform(base), uniform(rough), uniform(metal), scattered=1)
        ref = surface_of(material.node_tree)
        linked = ref is not None and ref.origin().socket.is_output
        output = ref and ref.node
        if output and output.inputs["Displacement"].is_linked:
            self.note(output, "displacement is not rendered")
        if output and output.inputs["Volume"].is_linked:
            self.note(output, "the volume is not rendered")
            if not linked:
                return None
        if not linked:
            self.report("has no surface, which is black in Blender; its viewport colour is used")
            return Surface(uniform(material.diffuse_color[:3]), uniform(material.roughness), scattered=1)
        surface = self.shader(ref)
        return None if surface.alpha.black else surface

    # Shaders

    @once(lambda self: Surface(uniform(self.unknown), scattered=1))
    def shader(self, ref: SocketRef) -> Surface:
        """The surface of a shader input."""
        origin = ref.origin()
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
        unsupported = [text for name, text in _LOBES.items() if name in node.inputs and _used(output.input(name))]
        if not 0.03 < self.reflectance(output) < 0.05:
            unsupported.append("specular other than that of IOR 1.5")
        self.warn_unsupported(output, unsupported)
        return Surface(
            self.colour(output.input("Base Color")),
            self.number(output.input("Roughness")),
            self.number(output.input("Metallic")),
            emission,
            scattered=1,
            alpha=alpha,
            details=self.normal_of(output),
        )

    def reflectance(self, output: SocketRef) -> float:
        """Reflectance of a Principled BSDF at normal incidence; that of IOR 1.5 where it varies."""
        ior, level = output.input("IOR").origin().socket, output.input("Specular IOR Level").origin().socket
        if ior.is_output or level.is_output:
            return float("nan")
        return reflectance(ior.default_value) * 2 * level.default_value

    def warn_unsupported(self, output: SocketRef, unsupported: list[str]) -> None:
        """One warning for all that a shader node does beyond the supported."""
        if unsupported:
            self.note(output.node, f"not rendered: {', '.join(unsupported)}")

    def shader_bsdf_diffuse(self, output: SocketRef) -> Surface:
        self.warn_unsupported(output, [])
        return Surface(self.colour(output.input("Color")), scattered=1, details=self.normal_of(output))

    def shader_bsdf_glossy(self, output: SocketRef) -> Surface:
        self.warn_unsupported(output, ["anisotropy"] if _used(output.input("Anisotropy")) else [])
        base, roughness = self.colour(output.input("Color")), self.number(output.input("Roughness"))
        return Surface(base, roughness, uniform(1), scattered=1, details=self.normal_of(output))

    def shader_bsdf_metallic(self, output: SocketRef) -> Surface:
        node = output.node
        unsupported = ["anisotropy"] if _used(output.input("Anisotropy")) else []
        if node.fresnel_type != "F82":
            unsupported.append("physical conductor (its Base Color is used)")
        self.warn_unsupported(output, unsupported)
        base, roughness = self.colour(output.inputs()["Base Color"]), self.number(output.input("Roughness"))
        return Surface(base, roughness, uniform(1), scattered=1, details=self.normal_of(output))

    def shader_emission(self, output: SocketRef) -> Surface:
        operands = self.colour(output.input("Color")), self.number(output.input("Strength"))
        return Surface(emission=self.combine(output.node, np.multiply, *operands))

    shader_background = shader_emission

    def shader_bsdf_transparent(self, output: SocketRef) -> Surface:
        colour = self.fixed(output.input("Color"))
        if np.ptp(colour) > 0.01 or colour.mean() < 0.99:
            self.warn(output.node, "coloured transparency is not rendered; it is clear")
        return Surface(alpha=uniform(0))

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
        sum_ = self.mixed(node, first, second, uniform(b / (a + b)))
        alpha = max(1 - (2 - a - b), _LEAST_ADDED)
        if a + b < 2:
            self.warn(node, f"light added to what passes: the surface hides {alpha:.0%} of what is behind it")
        scale = (a + b) / alpha
        return replace(
            sum_, base=sum_.base.times(scale), emission=sum_.emission.times(scale), alpha=uniform(alpha),
            scattered=min(1.0, sum_.scattered * scale),
        )  # fmt: skip

    def mixed(self, node: bpy.types.Node, first: Surface, second: Surface, share: SocketValue) -> Surface:
        """`share` of the second surface, the rest of the first; of roughness and metallic by what each scatters."""

        def mix(f: Array, a: Array, b: Array) -> Array:
            return a * (1 - f) + b * f

        mean = float(share.colour[0] * (1 if share.texture is None else self.mean(share.texture)[0]))
        weights = (1 - mean) * first.scattered, mean * second.scattered
        if first.scattered == second.scattered:
            rough_share = share
        else:
            rough_share = replace(share, colour=np.full(3, weights[1] / max(sum(weights), 1e-9)), texture=None)
        return Surface(
            self.combine(node, mix, share, first.base, second.base),
            self.combine(node, mix, rough_share, first.roughness, second.roughness),
            self.combine(node, mix, rough_share, first.metallic, second.metallic),
            self.combine(node, mix, share, first.emission, second.emission),
            scattered=sum(weights),
            details=self.stronger_details(node, first, second, weights),
        )

    def stronger_details(
        self, node: bpy.types.Node, first: Surface, second: Surface, weights: tuple[float, float]
    ) -> tuple[DetailRef, ...]:
        """Normal and bump maps of the surface that scatters more, for both."""
        more = first if weights[0] >= weights[1] else second
        alike = len(first.details) == len(second.details) and all(map(DetailRef.same, first.details, second.details))
        if min(weights) > 0 and not alike:
            self.warn(node, "its shaders have other normal or bump maps; those of the stronger one are used for both")
        return more.details if max(weights) > 0 else ()

    def other_shader(self, output: SocketRef) -> Surface:
        """The nearest to a shader that is not known: its colour, scattered."""
        node = output.node
        self.note(node, f"{node.bl_label} is not supported; a surface of its colour is used")
        colours = [s for s in node.inputs if s.type == "RGBA" and s.enabled]
        base = self.colour(SocketRef(colours[0], output.groups)) if colours else uniform(0.8)
        rough = output.input("Roughness") if "Roughness" in node.inputs else None
        rough_value = self.number(rough) if rough else uniform(1)
        return Surface(base, rough_value, scattered=1, details=self.normal_of(output))


def _unit(value: SocketValue) -> SocketValue:
    """Within [0, 1]; what a texture says is so where it is looked up."""
    if value.texture is not None:
        return value
    return replace(value, colour=np.clip(np.nan_to_num(value.colour, nan=1.0), 0, 1))


def _used(ref: SocketRef) -> bool:
    """Whether a number input is linked or not zero."""
    origin = ref.origin()
    return origin.socket.is_output or abs(constant(origin.socket)[0]) > 1e-4
