"""The general BSDF: energy, pdfs against sampling, Snell and Fresnel, reciprocity, and limits with a closed form."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.compute.jit import njit
from drgs_blender.core.materials import Material, Part, Texture
from drgs_blender.render.integrator.bsdf.albedo_tables import albedo_tables
from drgs_blender.render.integrator.bsdf.lobes import DELTA, LOBE, MOST_LOBES, evaluate, normalise_probabilities, sample
from drgs_blender.render.integrator.bsdf.microfacet import fresnel
from drgs_blender.render.integrator.bsdf.principled import add_material
from drgs_blender.render.scene.material_rows import KINDS, TEXTURES, material_rows

F = np.float32
WHITE = (1.0, 1.0, 1.0)


@njit
def _lobes(values, kind, flags, view, side, tables, b):  # type: ignore[no-untyped-def]
    up, count = (F(0.0), F(0.0), F(1.0)), 0
    for part in range(len(values)):
        p, along = values[part].copy(), (F(1.0), F(0.0), F(0.0))
        count = add_material(b, count, p, kind, flags, (up, up, up), along, view, side, tables)
    normalise_probabilities(b, count)
    return count


@njit
def _drawn(b, count, view, numbers, directions, values):  # type: ignore[no-untyped-def]
    """Directions of `sample`; values over pdf by class of light, and the pdf (0 of a delta, -1 of none)."""
    up, out = (F(0.0), F(0.0), F(1.0)), np.zeros(9, np.float32)
    for i in range(len(numbers)):
        x, y, z, lobe, passes, r, g, c = sample(b, count, view, numbers[i, 0], numbers[i, 1], numbers[i, 2])
        directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
        values[i, 9] = F(-1.0)
        if lobe < 0:
            continue
        if b[lobe + DELTA] > F(0.0):
            k = 6 if passes else 3
            values[i, k], values[i, k + 1], values[i, k + 2], values[i, 9] = r, g, c, F(0.0)
            continue
        pdf = evaluate(b, count, view, (x, y, z), up, out)
        if pdf > F(0.0):
            values[i, 9] = pdf
            for k in range(9):
                values[i, k] = out[k] / pdf


@njit
def _valued(b, count, view, directions, values):  # type: ignore[no-untyped-def]
    up, out = (F(0.0), F(0.0), F(1.0)), np.zeros(9, np.float32)
    for i in range(len(directions)):
        light = (directions[i, 0], directions[i, 1], directions[i, 2])
        values[i, 9] = evaluate(b, count, view, light, up, out)
        for k in range(9):
            values[i, k] = out[k]


@njit
def _fresnel(cosines, eta, out):  # type: ignore[no-untyped-def]
    for i in range(len(cosines)):
        out[i, 0], out[i, 1] = fresnel(cosines[i], eta)


class Surface:
    """A material of equal parts seen along (sin, 0, cos) from outside, or from inside where `side` is -1."""

    def __init__(self, cosine: float, side: float = 1.0, parts: int = 1, **fields) -> None:
        self.warnings: list[str] = []
        fields.setdefault("base_colour", WHITE)
        # Never plain: rows are made of materials with further lobes alone.
        shares = [Part(Material("m", **fields), (1 / parts,) * 3)] * parts
        rows = material_rows([Material("m", parts=shares)], None, lambda *_: None, self.warnings)
        kind, flags = KINDS.index(fields.get("kind", "principled")), (rows.ints[0, 1] == 1, rows.ints[0, 2] == 1)
        self.view = F(np.sqrt(1 - cosine * cosine)), F(0), F(cosine)
        self.lobes = np.zeros(MOST_LOBES * LOBE, np.float32)
        tables = albedo_tables(bool(flags[1]))
        self.count = _lobes(rows.values, kind, flags, self.view, F(side), tables, self.lobes)

    def drawn(self, n: int = 1 << 17) -> tuple[np.ndarray, np.ndarray]:
        numbers = np.random.default_rng(3).random((n, 3), dtype=np.float32)
        directions, values = np.empty((n, 3), np.float32), np.zeros((n, 10), np.float32)
        _drawn(self.lobes, self.count, self.view, numbers, directions, values)
        return directions, values

    def along(self, directions: np.ndarray) -> np.ndarray:
        values = np.zeros((len(directions), 10), np.float32)
        _valued(self.lobes, self.count, self.view, np.ascontiguousarray(directions, np.float32), values)
        return values


def everywhere(n: int = 1 << 19) -> np.ndarray:
    """Even directions, of 4 pi / n steradian each."""
    i = np.arange(n) + 0.5
    z, turn = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1).astype(np.float32)


LOOKS = {
    "plain": {"roughness": 0.6},
    "metal": {"roughness": 0.6, "metallic": 1.0},
    "brushed": {"roughness": 0.6, "metallic": 1.0, "anisotropy": 0.8, "anisotropy_rotation": 0.1},
    "coat": {"roughness": 0.7, "coat": 1.0, "coat_roughness": 0.5},
    "sheen": {"roughness": 0.7, "sheen": 1.0, "sheen_roughness": 0.4},
    "glass": {"roughness": 0.6, "transmission": 1.0},
    "sheet": {"roughness": 0.6, "transmission": 1.0, "thin_walled": True},
    "all": {"roughness": 0.6, "transmission": 0.5, "coat": 0.5, "coat_roughness": 0.4, "sheen": 0.5, "metallic": 0.3},
    "velvet": {"sheen_roughness": 0.5, "kind": "sheen"},
    "rough diffuse": {"diffuse_roughness": 1.0, "kind": "diffuse"},
    "translucent": {"kind": "translucent"},
    "glossy": {"roughness": 0.6, "anisotropy": -0.5, "kind": "glossy"},
    "refraction": {"roughness": 0.6, "kind": "refraction"},
}


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("side", (1.0, -1.0))
def test_sampling_pdf_and_value_agree(look, side):
    """What samples find is the integral of the values; the pdf counts every sample, and no more than all."""
    surface = Surface(0.6, side, **LOOKS[look])
    directions, values = surface.drawn()
    even = everywhere()
    valued = surface.along(even)
    step = 4 * np.pi / len(even)
    for first in (0, 3, 6):
        found, whole = values[:, first].mean(), valued[:, first].sum() * step
        assert found == pytest.approx(whole, rel=0.02, abs=2e-3)
        mean = (values[:, first, None] * directions).mean(axis=0)
        np.testing.assert_allclose(mean, (valued[:, first, None] * even).sum(axis=0) * step, atol=0.012)
    assert valued[:, 9].sum() * step == pytest.approx((values[:, 9] > 0).mean(), abs=0.012)


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("cosine", (0.95, 0.25))
def test_no_surface_sends_more_than_it_gets(look, cosine):
    for side in (1.0, -1.0):
        _, values = Surface(cosine, side, **LOOKS[look]).drawn(1 << 15)
        assert values[:, :9:3].sum(axis=1).mean() < 1.01


@pytest.mark.parametrize(
    "fields",
    (
        {"metallic": 1.0},
        *({"transmission": 1.0, "ior": ior} for ior in (0.5, 0.75, 1.5)),
        {"kind": "glass", "ior": 0.5},
        {"kind": "glossy"},
        {},
    ),
)
@pytest.mark.parametrize("cosine", (0.95, 0.25))
def test_multiscatter_loses_no_light(fields, cosine):
    for side in (1.0, -1.0):
        _, values = Surface(cosine, side, roughness=0.8, multiscatter=True, **fields).drawn()
        assert values[:, :9:3].sum(axis=1).mean() == pytest.approx(1.0, abs=0.012)


def test_all_lobes_of_all_parts_count():
    """Eight parts of six lobes each scatter what one of them does."""
    one, all_ = (Surface(0.6, parts=parts, **LOOKS["all"]) for parts in (1, 8))
    assert (one.count, all_.count) == (6, 48)
    even = everywhere(1 << 12)
    np.testing.assert_allclose(all_.along(even), one.along(even), rtol=1e-4, atol=1e-6)


# Closed forms, in colours


def mirrored(surface: Surface) -> np.ndarray:
    """(9,): value along the mirrored direction."""
    x, y, z = surface.view
    return surface.along(np.array([[-x, -y, z]]))[0, :9].astype(np.float64)


TINT = np.array([0.9, 0.4, 0.1])
BLACK = {"base_colour": (0, 0, 0), "specular_level": 0.0}


@pytest.mark.parametrize("cosine", (1.0, 0.6, 0.2))
def test_coat_absorbs_along_its_slanted_way_and_reflects_by_fresnel(cosine):
    """Diffuse light below loses what the coat reflects, and is tinted by the power of the way through it."""
    below = {"base_colour": WHITE, "specular_level": 0.0, "roughness": 0.9, "anisotropy": 0.7}
    coat = Surface(cosine, coat=0.8, coat_ior=1.8, coat_tint=tuple(TINT), coat_roughness=0.3, **below)
    inside = np.sqrt(1 - (1 - cosine * cosine) / 1.8**2)
    across, along = (cosine - 1.8 * inside) / (cosine + 1.8 * inside), (1.8 * cosine - inside) / (1.8 * cosine + inside)
    reflected = (across**2 + along**2) / 2
    found, bare = mirrored(coat), mirrored(Surface(cosine, **below))
    rest = (1 - 0.8 * reflected) * (1 + 0.8 * (TINT ** (1 / inside) - 1))
    np.testing.assert_allclose(found[:3] / bare[:3], rest, rtol=1e-4)
    whole = mirrored(Surface(cosine, kind="glossy", roughness=0.3))
    np.testing.assert_allclose(found[3:6] - bare[3:6] * rest, 0.8 * reflected * whole[3:6], rtol=1e-3)


def test_dielectric_reflects_along_its_normal_by_ior_level_and_tint():
    found = mirrored(Surface(1.0, roughness=0.4, ior=1.8, specular_level=0.8, specular_tint=tuple(TINT)))
    whole = mirrored(Surface(1.0, kind="glossy", roughness=0.4))
    np.testing.assert_allclose(found[3:6] / whole[3:6], (0.8 / 2.8) ** 2 * 1.6 * TINT, rtol=1e-4)


def test_edge_tint_of_metals_is_met_at_82_degrees():
    """At cosine 1/7 the reflectance is Schlick's times the tint."""
    base, cosine = np.array([0.8, 0.5, 0.0]), 1 / 7
    found = mirrored(Surface(cosine, metallic=1.0, roughness=0.3, base_colour=tuple(base), specular_tint=tuple(TINT)))
    whole = mirrored(Surface(cosine, kind="glossy", roughness=0.3))
    np.testing.assert_allclose(found[3:6] / whole[3:6], (base + (1 - base) * (6 / 7) ** 5) * TINT, rtol=1e-4)


def test_sheen_is_tinted_and_takes_its_largest_channel_from_below():
    sheen = {"sheen": 0.7, "sheen_roughness": 0.4, "sheen_tint": tuple(TINT)}
    alone = mirrored(Surface(0.3, **BLACK, **sheen))[:3]
    np.testing.assert_allclose(alone, mirrored(Surface(0.3, kind="sheen", sheen_roughness=0.4))[:3] * 0.7 * TINT, 1e-4)
    albedo = Surface(0.3, kind="sheen", sheen_roughness=0.4).drawn(1 << 14)[1][:, 0].mean()
    below = mirrored(Surface(0.3, specular_level=0.0))[:3]
    found = mirrored(Surface(0.3, specular_level=0.0, **sheen))[:3] - alone
    np.testing.assert_allclose(found, below * (1 - 0.7 * TINT.max() * albedo), rtol=1e-3)


def test_light_between_microfacets_is_coloured_at_each_of_them():
    """A geometric series: after the first, a part E of what each microfacet reflects leaves the surface."""
    cosine, colour = 0.5, np.array([1.0, 0.5, 0.1])

    def single(c: float) -> float:
        return Surface(c, kind="glossy", roughness=0.8).drawn(1 << 14)[1][:, 3].mean()

    nodes, weights = np.polynomial.legendre.leggauss(6)
    mean = sum(w * c * single(c) for c, w in zip((nodes + 1) / 2, weights))
    expected = colour * (single(cosine) + (1 - single(cosine)) * mean * colour / (1 - colour * (1 - mean)))
    fields = {"roughness": 0.8, "multiscatter": True, "base_colour": tuple(colour)}
    found = Surface(cosine, kind="glossy", **fields).drawn(1 << 15)[1][:, 3:6].mean(axis=0)
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_rough_diffuse_light_is_coloured_at_each_facet():
    """Along the normal 0.776 is scattered once, whatever the colour; the rest has its square more, as in Cycles."""
    colour = np.array([0.9, 0.5, 0.1])
    a = 1 / (np.pi + np.pi / 2 - 2 / 3)
    single, mean = a * np.pi, a * np.pi + (2 * np.pi - 5.6) / 3 * a
    expected = colour * (single + (1 - single) * colour**2 * mean / (1 - colour * (1 - mean)))
    np.testing.assert_allclose(expected, [0.8585, 0.4136, 0.0778], atol=1e-4)  # Cycles of Blender 5.0
    surface = Surface(1.0, kind="diffuse", base_colour=tuple(colour), diffuse_roughness=1.0)
    np.testing.assert_allclose(surface.drawn(1 << 15)[1][:, :3].mean(axis=0), expected, rtol=5e-3)


def test_colours_above_1_reflect_as_much_between_microfacets_as_white_does():
    fields = {"kind": "glossy", "roughness": 1.0, "multiscatter": True, "base_colour": (3.0, 1.0, 0.0)}
    found = Surface(0.8, **fields).drawn(1 << 15)[1][:, 3:6].mean(axis=0)
    np.testing.assert_allclose(found, [3.0, 1.0, 0.0], rtol=0.02)


@pytest.mark.parametrize("sign", (1, -1))
def test_rotation_turns_the_highlight_counterclockwise(sign):
    fields = {"roughness": 0.7, "metallic": 1.0, "anisotropy": 0.8, "anisotropy_rotation": sign * 0.1}
    turn = np.radians(np.arange(0, 180, 2.0))
    ring = np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), np.full(len(turn), 0.75**0.5)], axis=1)
    brightest = np.degrees(turn[Surface(1.0, **fields).along(ring)[:, 3].argmax()])
    assert brightest == pytest.approx(36 if sign > 0 else 144, abs=1.1)


def test_smooth_glass_follows_snell_and_fresnel():
    for side, cosine in ((1.0, 0.9), (1.0, 0.2), (-1.0, 0.9), (-1.0, 0.5)):
        eta = 1.6 if side > 0 else 1 / 1.6
        surface = Surface(cosine, side, roughness=0.0, ior=1.6, transmission=1.0)
        directions, values = surface.drawn(4096)
        sine = np.sqrt(1 - cosine * cosine)
        mirrored = directions[:, 2] > 0
        np.testing.assert_allclose(directions[mirrored], [[-sine, 0, cosine]] * mirrored.sum(), atol=2e-6)
        if sine / eta >= 1:
            assert mirrored.all() and values[:, 3] == pytest.approx(1)
            continue
        t = np.sqrt(1 - (sine / eta) ** 2)
        np.testing.assert_allclose(directions[~mirrored], [[-sine / eta, 0, -t]] * (~mirrored).sum(), atol=2e-6)
        across, along = (cosine - eta * t) / (cosine + eta * t), (eta * cosine - t) / (eta * cosine + t)
        reflectance = (across**2 + along**2) / 2
        assert values[:, 3].mean() == pytest.approx(reflectance, abs=0.03)
        # Radiance over probability: all light is one or the other.
        np.testing.assert_allclose(values[:, 3] + values[:, 6], 1, rtol=1e-5)


def test_fresnel_at_normal_and_brewster_angle():
    out = np.zeros((3, 2), np.float32)
    _fresnel(np.float32([1.0, np.cos(np.arctan(1.5)), 0.0]), F(1.5), out)
    assert out[0, 0] == pytest.approx(0.04) and out[2, 0] == pytest.approx(1)
    # At Brewster's angle one polarisation is let through whole.
    assert out[1, 0] == pytest.approx(((1 - 1.5**2) / (1 + 1.5**2)) ** 2 / 2, rel=1e-5)


def test_sheet_lets_light_through_in_a_straight_line():
    surface = Surface(0.7, roughness=0.0, transmission=1.0, thin_walled=True, base_colour=(0.5, 1, 1))
    directions, values = surface.drawn(4096)
    through = directions[:, 2] < 0
    np.testing.assert_allclose(directions[through], [[-v for v in surface.view]] * through.sum(), atol=2e-6)
    sine = np.sqrt(1 - 0.49)
    t = np.sqrt(1 - (sine / 1.5) ** 2)
    r = (((0.7 - 1.5 * t) / (0.7 + 1.5 * t)) ** 2 + ((1.05 - t) / (1.05 + t)) ** 2) / 2
    assert values[:, 4].mean() == pytest.approx(2 * r / (1 + r), abs=0.03)
    assert values[through, 6].mean() / values[through, 7].mean() == pytest.approx(0.5)


@pytest.mark.parametrize("look", ("metal", "brushed", "glossy", "rough diffuse"))
def test_single_lobes_are_reciprocal(look):
    """Value over cosine is the same when light and viewer change places."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        one, other = rng.normal(size=(2, 3))
        one[2], other[2] = abs(one[2]) + 0.1, abs(other[2]) + 0.1
        one, other = one / np.linalg.norm(one), other / np.linalg.norm(other)
        there, back = (_between(look, a, b) for a, b in ((one, other), (other, one)))
        assert there == pytest.approx(back, rel=2e-3, abs=1e-6)


def _between(look, view, light):
    # No rotation: surfaces here lie the same way round for any viewer.
    surface = Surface(0.5, **LOOKS[look])
    surface.view = tuple(F(v) for v in view)
    fields = LOOKS[look] | {"base_colour": WHITE}
    rows = material_rows([Material("m", parts=[Part(Material("m", **fields))])], None, lambda *_: None, [])
    kind = KINDS.index(fields.get("kind", "principled"))
    given = rows.values, kind, (False, False), surface.view, F(1), albedo_tables(False), surface.lobes
    surface.count = _lobes(*given)
    return (surface.along(np.array([light]))[0, [0, 3]] / light[2]).sum()


def test_neutral_values_add_nothing():
    """Coats, sheen and glass of weight 0 leave the lobes as they are."""
    plain = Surface(0.6, roughness=0.4)
    same = Surface(
        0.6, roughness=0.4, coat_roughness=0.7, sheen_roughness=0.2, coat_tint=(0, 0, 0), anisotropy_rotation=0.0
    )
    assert plain.count == same.count == 2
    np.testing.assert_array_equal(plain.lobes, same.lobes)


def test_bad_values_are_named_and_cut():
    surface = Surface(0.6, roughness=0.4, coat=np.nan, ior=-1.0, sheen=7.0, transmission=np.inf)
    assert len(surface.warnings) == 4 and all(w.startswith("m: ") and "out of range" in w for w in surface.warnings)
    assert np.isfinite(surface.lobes).all()


def test_only_materials_with_further_lobes_have_rows():
    plain, coated = Material("plain"), Material("coated", coat=0.5)
    assert material_rows([plain], None, None, []) is None
    rows = material_rows([plain, coated, plain], None, None, [])
    assert rows.parts.tolist() == [0, 1, 0] and rows.first[1] == 0
    warnings: list[str] = []
    many = Material("many", parts=[Part(coated)] * 12)
    assert material_rows([many], None, None, warnings).parts[0] == 8 and "mixes 12" in warnings[0]


def test_textures_of_parameters_get_rows():
    added = []

    def add(texture, subject, index):
        added.append(subject)
        return len(added) - 1

    material = Material("m", coat=1.0, textures={"coat": Texture("i")}, base_colour_texture=Texture("i"))
    rows = material_rows([material], add, lambda *_: None, [])
    assert sorted(added) == ["m, base colour", "m, coat"] and (rows.ints[0, TEXTURES:] >= 0).sum() == 2
