"""Formats that are not settled: what was taken from where, and what could not be verified; for docs/formats.md."""

from __future__ import annotations

#: A paragraph each.
DRAFTS: tuple[str, ...] = (
    """\
- **Gaussian surflets in USD**, `--kernel surflet`: a `ParticleField` with the APIs of positions, orientations, scales,
  opacities and spherical harmonics, and
  [ParticleFieldKernelGaussianSurfletAPI](https://openusd.org/release/user_guides/schemas/usdVol/ParticleFieldKernelGaussianSurfletAPI.html):
  a 2D Gaussian in the plane of X and Y, exactly a surfel. The scale along Z, which says nothing there, is that of the
  flat splat, for programs that take any kernel for an ellipsoid. OpenUSD 26.11 finds nothing wrong with it. No viewer
  that shows this kernel was there to try. Discs of constant opacity, the third kernel of OpenUSD, are refused.""",
    """\
- **SPZ in glTF**, KHR_gaussian_splatting_compression_spz_2, is a [draft of
  Khronos](https://github.com/KhronosGroup/glTF/pull/2531). `drgs convert --compress` writes it as the draft has it: SPZ
  in its own axes, half a turn about Y from those of glTF. By default it is version 2 of SPZ, which all that know the
  extension read; `--spz-version 3` has finer rotations, and fits the draft, too (release 2 of the library). The library
  of SPZ gives back what was written. Viewers could not be tried: Cesium's takes coordinates as they are stored, so what
  the draft describes may look half a turn off there. Files that lack `kernel` and `colorSpace`, as those of Cesium do,
  are read as Cesium shows them, with a note. Accessors of COLOR_0, which the draft has, and of OPACITY and SH_DEGREE_0,
  which the extension below it asks for, are all declared.""",
)
