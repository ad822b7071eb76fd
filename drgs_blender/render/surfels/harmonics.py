"""Real spherical harmonics of 3DGS in compiled code; `formats.harmonics` has them for arrays."""

from __future__ import annotations

from ...compute.jit import njit

#: The constant one.
CONSTANT = 0.28209479177387814
#: Coefficients that whole bands have, most first.
BANDS = (25, 16, 9, 4, 1)


@njit
def harmonics(x, y, z, count, out):  # type: ignore[no-untyped-def]
    """Real spherical harmonics of 3DGS, bands 0 to 4, in its order and with its signs.

    Parameters
    ----------
    x, y, z : float64
        Unit direction.
    count : int64
        How many are wanted: 1, 4, 9, 16 or 25.
    out : (25,) float64 array
        The first `count` are written.
    """
    out[0] = CONSTANT
    if count < 4:
        return
    a = 0.4886025119029199
    out[1], out[2], out[3] = -a * y, a * z, -a * x
    if count < 9:
        return
    xx, yy, zz = x * x, y * y, z * z
    c2, s2 = xx - yy, 2.0 * x * y
    a, b, c = 1.0925484305920792, 0.9461746957575601 * zz - 0.31539156525252005, 0.5462742152960396
    out[4], out[5], out[6], out[7], out[8] = c * s2, -a * y * z, b, -a * x * z, c * c2
    if count < 16:
        return
    c3, s3 = x * c2 - y * s2, x * s2 + y * c2
    a, b, c = 0.5900435899266435, 1.445305721320277 * z, 0.4570457994644658 * (1.0 - 5.0 * zz)
    d = 1.865881662950577 * z * zz - 1.119528997770346 * z
    out[9], out[10], out[11], out[12], out[13], out[14], out[15] = -a * s3, b * s2, c * y, d, c * x, b * c2, -a * c3
    if count < 25:
        return
    c4, s4 = x * c3 - y * s3, x * s3 + y * c3
    a, b, c = 0.6258357354491761, -1.7701307697799304 * z, 3.3116114351514603 * zz - 0.47308734787878004
    e = z * (2.0071396306718676 - 4.683325804901025 * zz)
    out[16], out[17], out[18], out[19] = a * s4, b * s3, c * s2, e * y
    out[20] = 1.984313483298443 * z * d - 1.006230589874905 * out[6]
    out[21], out[22], out[23], out[24] = e * x, c * c2, b * c3, a * c4
