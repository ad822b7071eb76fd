"""Multiple importance sampling (MIS): the balance heuristic, which joins strategies that sample the same integral.

A sample is divided by the sum, over the strategies that might have drawn it, of number of samples times pdf (Veach
1997; PBRT 2.2.3): that is its weight over its pdf. The power heuristic, which squares both, is used where a picture
depends on the weights: at the shadow terminator, and behind what does not block a light. The strategies
are cosine and GGX sampling (two lobes of a BRDF), the environment, and lights, whose weight `light_visibility` has,
since their visibility is found there.
"""

from __future__ import annotations

from ...compute.jit import inlined, njit
from ..lights.environment import envmap_pdf, height_in_map
from ..lights.product_sampling import SIDE
from ..sampling import ONE, ZERO, F, U, luminance
from . import brdf
from . import wavefront as w

_TINY = F(1e-30)


@inlined
def power_heuristic(own, other):  # type: ignore[no-untyped-def]
    """Weight of a sample by the power heuristic (Veach 1997).

    Parameters
    ----------
    own, other : float32
        Pdf of its strategy, sr^-1, and of the other one.

    Returns
    -------
    float32
        In [0, 1].
    """
    ratio = other / max(own, _TINY)
    return ONE / (ONE + ratio * ratio) if own > ZERO else ZERO


@inlined
def _weight_over_pdf(s, i, cosine, ggx):  # type: ignore[no-untyped-def]
    """One over the density of all strategies together for the slot at i."""
    return ONE / max(w.brdf_pdf(s, i, cosine, ggx) + s[i + w.WE] * s[i + w.PE], _TINY)


@inlined
def _scale(s, i, k):  # type: ignore[no-untyped-def]
    """Multiply both lobes of the slot at i."""
    s[i + w.QR], s[i + w.QG], s[i + w.QB] = s[i + w.QR] * k, s[i + w.QG] * k, s[i + w.QB] * k
    s[i + w.SR], s[i + w.SG], s[i + w.SB] = s[i + w.SR] * k, s[i + w.SG] * k, s[i + w.SB] * k


@inlined
def balance_heuristic_at(s, i, cosine, ggx):  # type: ignore[no-untyped-def]
    """`balance_heuristic` for one slot.

    Parameters
    ----------
    s : (packets * 60 * LANES,) float32 array
        `Batch.floats`.
    i : int64
        Index of the slot in it, see `wavefront.at`.
    cosine, ggx : float32
        As of `balance_heuristic`.
    """
    _scale(s, i, _weight_over_pdf(s, i, cosine, ggx))


@njit
def balance_heuristic(rays, count, cosine, ggx):  # type: ignore[no-untyped-def]
    """MIS weight over pdf (balance heuristic, PBRT 2.2.3): divide both lobes by the sum of count times pdf.

    The strategies are environment, cosine and GGX; lights have a density of their own, see `light_visibility`.

    Parameters
    ----------
    rays : Batch
        WC, WG, WE (counts) and PC, PG, PE (pdfs) are read; QR, QG, QB, SR, SG, SB are divided; ER is overwritten.
    count : int64
        Slots.
    cosine, ggx : float32
        1 or 0: whether cosine and GGX sampling take part.
    """
    s = rays.floats
    for p in range(w.packets(count)):
        # Two loops, for LLVM vectorises none that reads and writes this many arrays.
        for i in range(p * w.PACKET_FLOATS, p * w.PACKET_FLOATS + w.LANES):
            s[i + w.ER] = _weight_over_pdf(s, i, cosine, ggx)
        for i in range(p * w.PACKET_FLOATS, p * w.PACKET_FLOATS + w.LANES):
            _scale(s, i, s[i + w.ER])


@njit
def balance_heuristic_per_lobe(rays, count):  # type: ignore[no-untyped-def]
    """`balance_heuristic` where cosine sampling is of the diffuse lobe alone, GGX sampling of the specular one alone.

    Parameters
    ----------
    rays : Batch
        As of `balance_heuristic`; ER stays as it is.
    count : int64
        Slots.
    """
    s = rays.floats
    for p in range(w.packets(count)):
        for i in range(p * w.PACKET_FLOATS, p * w.PACKET_FLOATS + w.LANES):
            light = s[i + w.WE] * s[i + w.PE]
            k = ONE / max(s[i + w.WC] * s[i + w.PC] + light, _TINY)
            s[i + w.QR], s[i + w.QG], s[i + w.QB] = s[i + w.QR] * k, s[i + w.QG] * k, s[i + w.QB] * k
            k = ONE / max(s[i + w.WG] * s[i + w.PG] + light, _TINY)
            s[i + w.SR], s[i + w.SG], s[i + w.SB] = s[i + w.SR] * k, s[i + w.SG] * k, s[i + w.SB] * k


@njit
def _light_weight(s, i, settings, envmap):  # type: ignore[no-untyped-def]
    """Weight that Cycles gives the environment's sample along the direction of the slot at i, by the power heuristic.

    Cycles has one sample by the environment's power alone, and one of the BRDF, with lobes picked by what they reflect
    towards the viewer.
    """
    mv = max(s[i + w.MX] * s[i + w.VX] + s[i + w.MY] * s[i + w.VY] + s[i + w.MZ] * s[i + w.VZ], ZERO)
    albedo, metal = (s[i + w.AR], s[i + w.AG], s[i + w.AB]), (s[i + w.FR], s[i + w.FG], s[i + w.FB])
    fr, fg, fb = brdf.fresnel(mv, albedo, metal, s[i + w.FD], settings.shading_model)
    diffuse, glossy = s[i + w.KD] * luminance(albedo[0], albedo[1], albedo[2]), luminance(fr, fg, fb)
    density = (diffuse * s[i + w.PC] + glossy * s[i + w.PG]) / max(diffuse + glossy, _TINY)
    z = height_in_map(s[i + w.LX], s[i + w.LY], s[i + w.LZ], envmap)
    light = envmap_pdf(s[i + w.MU], s[i + w.MV], z, U(SIDE * SIDE), envmap)
    return power_heuristic(light, density)


@njit
def terminator_weights(rays, count, settings, envmap):  # type: ignore[no-untyped-def]
    """MIS weights of environment samples whose shadow rays start off the surface (`scene.terminator`).

    Rays of cosine and GGX samples start on the surface and meet other things, so what is seen depends on the weights:
    they are those of Cycles. No other strategy takes part, see `terminator_part`.

    Parameters
    ----------
    rays : Batch
        As `wavefront.evaluate` left it; both lobes are scaled by the weight, PC and PG set to 0.
    count : int64
        Slots.
    settings : Settings
    envmap : EnvMap
    """
    s = rays.floats
    for slot in range(count):
        i, _ = w.at(slot)
        if w.grazing(s, i) > ZERO:
            _scale(s, i, _light_weight(s, i, settings, envmap))
            s[i + w.PC] = s[i + w.PG] = ZERO


@njit
def terminator_part(s, i, cosine, ggx, settings, envmap):  # type: ignore[no-untyped-def]
    """Factor of the environment's light along a cosine or GGX sample, for the weights of `terminator_weights`.

    Parameters
    ----------
    s, i, cosine, ggx : float32 array, int64 or float32
        As of `balance_heuristic_at`.
    settings : Settings
    envmap : EnvMap

    Returns
    -------
    float32
        1 where shadow rays start on the surface.
    """
    if not w.grazing(s, i) > ZERO:
        return ONE
    others = w.brdf_pdf(s, i, cosine, ggx)
    own = ONE - _light_weight(s, i, settings, envmap)
    return own * (ONE + s[i + w.WE] * s[i + w.PE] / max(others, _TINY))


@njit
def path_weights(rays, count, light):  # type: ignore[no-untyped-def]
    """Throughput of a path times both lobes, and the pdfs that its samples are divided by.

    Parameters
    ----------
    rays : Batch
        TR, TG, TB (throughput), both lobes, PC, PG, PE and SHARE are read. Written: QR, QG, QB (throughput times BRDF
        times cosine, linear Rec.709), PG (pdf of the mixture of lobes, sr^-1), PE (that plus `light` times the pdf of
        environment sampling).
    count : int64
        Slots.
    light : float32
        1 or 0: whether an environment sample is part of the MIS weight in PE.
    """
    s = rays.floats
    for p in range(w.packets(count)):
        for i in range(p * w.PACKET_FLOATS, p * w.PACKET_FLOATS + w.LANES):
            s[i + w.QR] = s[i + w.TR] * (s[i + w.QR] + s[i + w.SR])
            s[i + w.QG] = s[i + w.TG] * (s[i + w.QG] + s[i + w.SG])
            s[i + w.QB] = s[i + w.TB] * (s[i + w.QB] + s[i + w.SB])
            density = max(w.mixture_pdf(s, i), _TINY)
            s[i + w.PG] = density
            s[i + w.PE] = density + light * s[i + w.PE]
