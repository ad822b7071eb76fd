"""Honest files of every format that is read, damaged copies of them, and a program that reads those one by one.

    python tests/unit/fuzz_files.py FOLDER FIRST COUNT KIND ...

prints a line for every copy (of the first kind from number FIRST on) with which something is wrong: a crash of Python,
an array that cannot be used, an altered file of ours that is accepted, more memory than four times what the honest
file needs, more than five seconds of processor time of a process that reads for it. A copy that takes longer than that
itself, or kills the program, ends it; the copy at hand is in FOLDER. A KIND may also be a folder of files that are
damaged already.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import os
import resource
import signal
import struct
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import scene_files
from splat_files import build_spz, old_spz, random_splats, spz_blocks
from test_container import DATA_MEMBERS, make_asset, rewrite
from test_formats_environment import encode_hdr, rgbe_pixels
from test_formats_splats import ksplat

from drgs_blender.core.asset import Environment, Mesh
from drgs_blender.core.asset.archive import read_archive
from drgs_blender.core.asset.container import MANIFEST, check_asset, read_asset, write_asset
from drgs_blender.core.errors import DrgsError
from drgs_blender.formats.gltf_splats import write_gltf_splats
from drgs_blender.formats.registry import read
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import SplatMaterials
from drgs_blender.formats.usd_splats import write_usd_splats
from drgs_blender.formats.writers import WRITERS
from drgs_blender.render.film.frame_files import read_frame, write_frame

Parts = Mapping[str, bytes]

SECONDS = float(os.environ.get("DRGS_FUZZ_SECONDS", 5))
#: What interpreters and allocators take besides; and what usd-core takes for a value, and Pillow for a picture, that
#: say of themselves how large they are and could be so large in so small a file.
SLACK, SLACK_DECODERS = 24 << 20, 256 << 20


@dataclass(frozen=True)
class Kind:
    """A format, by an honest file of it.

    Attributes
    ----------
    name : of the file
    parts : what is damaged
    build : puts damaged parts together so that hashes and checksums around them agree
    read : path -> what comes out
    sealed : damage must be noticed; "content": where it does not show in what is read it may pass
    """

    name: str
    parts: Parts
    build: Callable[[Parts], bytes] = lambda parts: parts["file"]
    read: Callable[[Path], object] = read
    sealed: Literal["", "file", "content"] = ""


def square(n: int = 9) -> Mesh:
    """A bent sheet with materials."""
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, n), np.linspace(-0.5, 0.5, n))
    vertices = np.stack([x.ravel(), np.sin(x).ravel(), z.ravel()], axis=1)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()[:, None]
    faces = np.concatenate([corner + np.array(offsets) for offsets in ((0, 1, n + 1), (0, n + 1, n))])
    count = len(vertices)
    return Mesh(vertices, faces, np.full((count, 3), 0.8), np.full(count, 0.5), np.zeros(count))


def kinds() -> dict[str, Callable[[], Kind]]:
    """Name -> function that makes it; optional packages are needed only there."""
    made: dict[str, Callable[[], Kind]] = {}
    splats, mesh = random_splats(60), square()
    sky = Environment(np.random.default_rng(1).uniform(0, 5, (8, 16, 3)).astype(np.float32))
    given = {"splats": splats, "mesh": mesh, "environment": sky}

    def whole(name: str, data: bytes) -> Callable[[], Kind]:
        return lambda: Kind(name, {"file": data})

    def written(write: Callable[[Path, object], None], name: str, what: object) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            write(path, what)
            return path.read_bytes()

    for writer in WRITERS:
        if writer.name == "USD mesh" or writer.kind == "sequence":
            continue  # is not read
        for suffix in writer.extensions:
            name = f"{writer.kind}{suffix}"
            made[name] = lambda w=writer, n=name: Kind(n, {"file": written(w.write, n, given[w.kind])})
    materials = SplatMaterials(np.full((60, 3), 0.3), np.full(60, 0.4), np.full(60, 0.2))
    lit = replace(splats, materials=materials)
    for suffix, write in ((".ply", write_splat_ply), (".glb", write_gltf_splats)):
        of = partial(write, materials=True)
        made[f"materials{suffix}"] = lambda w=of, n=f"a{suffix}": Kind(n, {"file": written(w, n, lit)})
    surflets = partial(write_usd_splats, kernel="surflet")
    made["surflets.usda"] = lambda: Kind("a.usda", {"file": written(surflets, "a.usda", splats)})
    packed = partial(write_gltf_splats, compress=True)
    made["packed.glb"] = lambda: Kind("a.glb", {"file": written(packed, "a.glb", splats)})
    for version in (2, 3):
        made[f"version{version}.spz"] = lambda v=version: Kind(
            "a.spz", {"file": old_spz(made["splats.spz"]().parts["file"], v)}
        )
    for name in [name for name in made if name.endswith((".sog", ".spz", ".glb"))]:
        made[f"{name} inside"] = lambda n=name: inside(made[n]())
    for level in (0, 1, 2):
        made[f"level{level}.ksplat"] = whole("a.ksplat", ksplat(level)[0])
    for runs in ("new", "old", "none"):
        made[f"{runs}.hdr"] = whole("a.hdr", encode_hdr(rgbe_pixels(), runs))
    for encoding in ("ascii", "little", "big"):
        made[f"{encoding}.ply"] = whole("a.ply", ply(mesh, encoding))
    made["compressed.ply"] = whole("a.ply", compressed_ply())
    made["mesh.obj"] = whole("a.obj", obj(mesh))
    corners = mesh.vertices.astype(np.float32)[mesh.faces]
    vertices = mesh.vertices.astype(float)
    made["binary.stl"] = whole("a.stl", scene_files.binary_stl(corners))
    made["text.stl"] = whole("a.stl", scene_files.text_stl(corners))
    made["mesh.off"] = whole("a.off", scene_files.off(vertices, mesh.faces))
    package = scene_files.threemf(scene_files.model(vertices, mesh.faces))
    made["mesh.3mf"] = whole("a.3mf", package)
    made["mesh.3mf inside"] = lambda: inside(Kind("a.3mf", {"file": package}))
    made["mesh.dae"] = whole("a.dae", scene_files.collada(vertices, mesh.faces.tolist()))
    made["a.splat"] = whole("a.splat", splat_records(len(splats)))
    for suffix in ("png", "jpg", "webp"):
        made[f"picture.{suffix}"] = lambda s=suffix: Kind(f"a.{s}", {"file": picture(s)})
    made["picture.tif"] = whole("a.tif", tiff())
    made["light.map"] = lambda: inside(Kind("a.map", {"file": learned_light()}))
    made["whole light.map"] = lambda: Kind("a.map", {"file": learned_light()})
    for member in (MANIFEST, *DATA_MEMBERS):
        made[f"drgs {member}"] = lambda m=member: Kind("a.drgs", drgs_parts(m), rebuild_drgs, checked_asset)
    made["drgs"] = lambda: Kind(
        "a.drgs", {"file": written(write_asset, "a.drgs", make_asset())}, read=checked_asset, sealed="file"
    )
    made["frame"] = lambda: Kind(
        "a.exr", {"file": written(write_one_frame, "a.exr", None)}, read=read_frame, sealed="content"
    )
    return made


def ply(mesh: Mesh, encoding: str) -> bytes:
    """The mesh with a colour a vertex."""
    kind = {"ascii": "ascii", "little": "binary_little_endian", "big": "binary_big_endian"}[encoding]
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(mesh.vertices)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar red\n"
    head += f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    if encoding == "ascii":
        body = "".join(f"{x:.4f} {y:.4f} {z:.4f} 200\n" for x, y, z in mesh.vertices)
        return (head + body + "".join(f"3 {a} {b} {c}\n" for a, b, c in mesh.faces)).encode()
    order = "<" if encoding == "little" else ">"
    vertices = np.zeros(len(mesh.vertices), [("p", f"{order}f4", 3), ("red", "u1")])
    vertices["p"], vertices["red"] = mesh.vertices, 200
    faces = np.zeros(len(mesh.faces), [("n", "u1"), ("v", f"{order}i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    return head.encode() + vertices.tobytes() + faces.tobytes()


def compressed_ply(n: int = 300) -> bytes:
    """Splats as SuperSplat packs them."""
    rng = np.random.default_rng(3)
    ends = [f"{end}_{c}" for end in ("min", "max") for c in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
    chunk = np.tile(np.float32([0, 0, 0, -5, -5, -5, 1, 1, 1, -1, -1, -1]), (2, 1))
    names = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 2", *(f"property float {end}" for end in ends)]
    lines += [f"element vertex {n}", *(f"property uint {name}" for name in names), "end_header", ""]
    return "\n".join(lines).encode() + chunk.tobytes() + rng.integers(0, 2**32, (n, 4), np.uint32).tobytes()


def obj(mesh: Mesh) -> bytes:
    """The mesh with texture coordinates."""
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices]
    lines += [f"vt {x:.4f} {z:.4f}" for x, _, z in mesh.vertices]
    lines += ["o sheet", *(" ".join(["f", *(f"{k + 1}/{k + 1}" for k in face)]) for face in mesh.faces)]
    return "\n".join(lines).encode()


def splat_records(n: int) -> bytes:
    """Records of 32 bytes: position, scale, colour, quaternion."""
    rng = np.random.default_rng(2)
    records = np.zeros(n, [("p", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)])
    records["p"], records["s"] = rng.uniform(-1, 1, (n, 3)), rng.uniform(0.01, 0.1, (n, 3))
    records["c"], records["q"] = rng.integers(1, 256, (n, 4)), rng.integers(1, 256, (n, 4))
    return records.tobytes()


def picture(suffix: str) -> bytes:
    """A small coloured picture."""
    from PIL import Image

    data = io.BytesIO()
    pixels = np.random.default_rng(3).integers(0, 256, (16, 32, 3), np.uint8)
    Image.fromarray(pixels).save(data, "JPEG" if suffix == "jpg" else suffix.upper())
    return data.getvalue()


def tiff() -> bytes:
    """A small picture of floats."""
    import tifffile

    data = io.BytesIO()
    tifffile.imwrite(
        data, np.random.default_rng(3).random((16, 32, 3), np.float32), photometric="rgb", compression="zlib"
    )
    return data.getvalue()


def learned_light() -> bytes:
    """A light as IRGS keeps it."""
    import torch

    data = io.BytesIO()
    torch.save({"base": torch.nn.Parameter(torch.zeros(8, 16, 3))}, data)
    return data.getvalue()


def write_one_frame(path: Path, _: object) -> None:
    """A rendered frame."""
    passes = {"Combined": np.random.default_rng(4).random((12, 16, 4), np.float32), "Depth": np.ones((12, 16, 1))}
    write_frame(path, {name: p.astype(np.float32) for name, p in passes.items()}, {"frame": "1"})


def inside(kind: Kind) -> Kind:
    """The members of a zip, what a gzip or SPZ holds, the chunks of a GLB; checksums and sizes around them agree."""
    data = kind.parts["file"]
    if data[:4] == b"glTF":
        return Kind(kind.name, glb_chunks(data), build_glb)
    if data[:2] == b"\x1f\x8b":
        return Kind(kind.name, {"file": gzip.decompress(data)}, lambda parts: gzip.compress(parts["file"], 1))
    if data[:4] == b"NGSP":
        blocks = {str(i): block for i, block in enumerate(spz_blocks(data))}
        return Kind(kind.name, blocks, lambda parts: build_spz(data, list(parts.values())))
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError(f"{kind.name}: nothing is packed in it")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}

    def build(parts: Parts) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as archive:
            for name, content in parts.items():
                archive.writestr(name, content)
        return out.getvalue()

    return Kind(kind.name, members, build)


def glb_chunks(data: bytes) -> Parts:
    """The text and the bulk of a GLB."""
    (length,) = struct.unpack_from("<I", data, 12)
    return {"text": data[20 : 20 + length], "bulk": data[28 + length :]}


def build_glb(parts: Parts) -> bytes:
    """A GLB of these chunks."""
    chunks = [(parts["text"], b"JSON", b" "), (parts["bulk"], b"BIN\0", b"\0")]
    body = b""
    for content, name, filling in chunks:
        content += filling * (-len(content) % 4)
        body += struct.pack("<I", len(content)) + name + content
    return b"glTF" + struct.pack("<2I", 2, 12 + len(body)) + body


def drgs_parts(member: str) -> Parts:
    """One member of an asset, which alone is damaged."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.drgs"
        write_asset(path, make_asset())
        return {member: read_archive(path)[member].tobytes()}


def rebuild_drgs(parts: Parts) -> bytes:
    """The asset with damaged members and the hashes of those."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.drgs"
        write_asset(path, make_asset())
        rewrite(path, dict(parts))
        return path.read_bytes()


def checked_asset(path: Path) -> object:
    """Read an asset as the engine does."""
    asset = read_asset(path)
    check_asset(asset, str(path))
    return asset


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """A copy with a few other bytes, with a number made extreme, a piece cut out, doubled, or only its beginning."""
    changed = bytearray(data)
    near = int(rng.choice([min(len(data), 64), min(len(data), 400), len(data)]))
    place = int(rng.integers(near))
    how = rng.integers(6)
    if how <= 1:
        for _ in range(rng.integers(1, 6)):
            changed[rng.integers(near)] = rng.integers(256)
    elif how == 2:
        extreme = (
            b"\xff" * 4,
            b"\0" * 4,
            b"\xff\xff\xff\x7f",
            b"\0\0\xc0\x7f",
            b"\0\0\x80\x7f",
            b"9999",
            b"\x40\x42\x0f\0",
        )
        word = extreme[rng.integers(len(extreme))]
        changed[place : place + 4] = word[: len(changed) - place]
    elif how == 3:
        del changed[place : place + int(rng.integers(1, 40))]
    elif how == 4:
        piece = changed[place : place + int(rng.integers(1, 40))]
        changed[place:place] = piece
    else:
        del changed[int(rng.integers(len(data))) :]
    return bytes(changed)


def mutant(kind: Kind, number: int) -> bytes | None:
    """The damaged copy of that number; None where it is the honest one."""
    rng = np.random.default_rng([number, len(kind.name)])
    parts = dict(kind.parts)
    name = sorted(parts)[rng.integers(len(parts))]
    parts[name] = damaged(parts[name], rng)
    return None if parts == dict(kind.parts) else kind.build(parts)


def peak() -> int:
    """Bytes of the most memory this process had since `forget_peak`."""
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0]) << 10


def forget_peak() -> int:
    """Bytes of memory now."""
    Path("/proc/self/clear_refs").write_text("5")
    return int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0]) << 10


def apart() -> tuple[float, int]:
    """Of processes that were started to read: processor seconds of all, and the most bytes of memory of any, so far."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss << 10


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """A processor time that ends the process."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def attempt(kind: Kind, path: Path, need: int | None = None, honest: object = None) -> str:
    """Read a file; what is wrong with how that ended, "" when nothing is."""
    before, (seconds, largest) = forget_peak(), apart()
    try:
        with limited():
            found = kind.read(path)
    except DrgsError as error:
        named = path.stem in str(error) or str(path.parent) in str(error)
        problem = "" if named else f"refused without its name: {error}"
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    else:
        altered = kind.sealed == "file" or (kind.sealed == "content" and not same(found, honest))
        problem = "altered, and accepted" if altered and need is not None else fault(found)
    used = max(peak() - before, apart()[1] - largest)
    if not problem and (taken := apart()[0] - seconds) > SECONDS + 1:  # the system counts whole seconds
        problem = f"took {taken:.1f} s of a process of its own"
    slack = SLACK_DECODERS if path.suffix in (".usd", ".usdc", ".png", ".jpg", ".webp", ".tif") else SLACK
    if not problem and need is not None and used > 4 * need + slack:
        problem = f"took {used >> 20} MiB, {need >> 20} MiB would be honest"
    return problem


def fault(found: object) -> str:
    """What makes the content of a file unusable, "" when it is fine."""
    for name, array in arrays(found):
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            return f"{name} is not finite"
    faces, vertices = getattr(found, "faces", None), getattr(found, "vertices", ())
    if faces is not None and len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        return "faces refer to vertices that are not there"
    return ""


def same(found: object, honest: object) -> bool:
    """Whether arrays, and what stands beside them, are equal."""
    pairs = zip(arrays(found), arrays(honest), strict=False)
    return repr(found) == repr(honest) and all(a == b and np.array_equal(x, y) for (a, x), (b, y) in pairs)


def arrays(found: object, name: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Every array in dataclasses, lists and dictionaries."""
    if isinstance(found, np.ndarray):
        yield name, found
    elif is_dataclass(found):
        for field in fields(found):
            yield from arrays(getattr(found, field.name), f"{name}.{field.name}")
    elif isinstance(found, Mapping):
        for key, value in found.items():
            yield from arrays(value, f"{name}.{key}")
    elif isinstance(found, list | tuple):
        for value in found:
            yield from arrays(value, name)


def read_all(folder: Path, first: int, now: Path) -> None:
    """Read the files of a folder from number `first` on; what any of them honestly needs is some times its size."""
    for number, path in enumerate(sorted(p for p in folder.rglob("*") if p.is_file())):
        now.write_text(json.dumps([str(folder), number]))
        if number < first:
            continue
        # The first file of a format imports its reader: only the second time is the memory its own.
        if problem := [attempt(Kind("", {}), path, 16 * path.stat().st_size) for _ in range(2)][1]:
            print(json.dumps([str(path), number, problem]), flush=True)


def main() -> None:
    """Read mutants; a last line says that all of them were."""
    folder, first, count, names = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
    resource.setrlimit(resource.RLIMIT_DATA, (4 << 30, resource.RLIM_INFINITY))
    every = kinds()
    for name in names:
        if Path(name).is_dir():
            read_all(Path(name), first, folder / "now")
            continue
        kind = every[name]()
        path = folder / kind.name
        path.write_bytes(kind.build(kind.parts))
        if problem := [attempt(kind, path), attempt(kind, path)][1]:
            raise SystemExit(f"{name}: the honest file: {problem}")
        start = forget_peak()
        honest = kind.read(path)
        need = peak() - start
        for number in range(first, count):
            data = mutant(kind, number)
            if data is None:
                continue
            path.write_bytes(data)
            (folder / "now").write_text(json.dumps([name, number]))
            if problem := attempt(kind, path, need, honest):
                print(json.dumps([name, number, problem]), flush=True)
                (folder / f"{number}-{path.name}").write_bytes(data)
        first = 0
    print(json.dumps(["done", count, ""]), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
