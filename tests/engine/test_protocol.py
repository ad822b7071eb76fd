"""Messages: what is sent arrives, and nothing else is accepted."""

from __future__ import annotations

import dataclasses
import errno
import gc
import io
import json
import os
import random
import socket
import sys

import numpy as np
import pytest

from drgs_blender.core.arrays import (
    LARGE_BYTES,
    SHARED_BYTES,
    SHARED_FILES,
    SharedMemory,
    frozen,
    keep,
    shareable,
    shared_file,
)
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.ipc import protocol
from drgs_blender.ipc.codec import CodecError, decode_frame, encode_frame
from drgs_blender.ipc.protocol import MAGIC, PREFIX, Link, ProtocolError
from drgs_blender.ipc.shared_memory import Region
from drgs_blender.ipc.slots import HeldSlots, SentSlots


def full_frame() -> Frame:
    rng = np.random.default_rng(1)
    camera = Camera(rng.normal(size=(4, 4)), 640, 480, 500.0, 501.0, 320.0, 240.0, region=(1, 2, 30, 40))
    floats = rng.normal(size=(5, 3)).astype(np.float32)
    first = ObjectState("Ä / robe", "k", vertices=floats, albedo=floats, roughness=floats[:, 0].copy(), pass_index=-2)
    world = World(rng.uniform(size=(4, 8, 3)).astype(np.float32), colour=(0.5, 1.0, 0.25), strength=2.5)
    settings = RenderSettings(denoise="svgf", film_transparent=True, seed=2**40)
    return Frame(7, camera, [first, ObjectState("b", "k")], world, settings, ("Combined", "Depth"))


def assert_equal(a: object, b: object) -> None:
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for f in dataclasses.fields(a):
            assert_equal(getattr(a, f.name), getattr(b, f.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype  # type: ignore[attr-defined]
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, list):
        assert len(a) == len(b)  # type: ignore[arg-type]
        for x, y in zip(a, b):  # type: ignore[call-overload]
            assert_equal(x, y)
    else:
        assert a == b


def loop(*, shared: bool = False) -> tuple[Link, io.BytesIO]:
    """A link that receives what it sent, after a seek."""
    pipe = io.BytesIO()
    link = Link(pipe, pipe)  # type: ignore[arg-type]
    if shared:
        link.incoming = link.outgoing = Region.create()
        if link.outgoing is None:
            pytest.skip("this system has no anonymous shared memory")
    return link, pipe


def wire(content: object, behind: bytes = b"", **prefix: object) -> bytes:
    """A message with any header and prefix."""
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    parts = {"magic": MAGIC, "header": len(text), "payload": len(behind)} | prefix
    return PREFIX.pack(parts["magic"], parts["header"], parts["payload"]) + text + behind


def receive(data: bytes) -> object:
    return Link(io.BytesIO(data), io.BytesIO()).receive()  # type: ignore[arg-type]


def header(**change: object) -> dict[str, object]:
    body = {"id": 1, "warnings": [], "statistics": {}}
    return {"type": "Result", "body": body, "where": "inline", "arrays": [], "files": []} | change


def test_frame_survives_the_way_through_json():
    frame = full_frame()
    data, arrays = encode_frame(frame)
    assert_equal(decode_frame(json.loads(json.dumps(data)), arrays), frame)
    assert "objects/Ä / robe/vertices" in arrays
    assert "world/environment" in arrays


def test_numpy_scalars_are_sent_as_numbers():
    frame = full_frame()
    frame.noise_index, frame.camera.fx, frame.camera.orthographic = np.int64(9), np.float32(2.5), np.bool_(True)  # type: ignore
    data, arrays = encode_frame(frame)
    back = decode_frame(json.loads(json.dumps(data)), arrays)
    assert (back.noise_index, back.camera.fx, back.camera.orthographic) == (9, 2.5, True)


def test_objects_of_one_name_get_slots_of_their_own():
    frame = full_frame()
    frame.objects = [ObjectState("x", "k", vertices=np.full((1, 3), i, np.float32)) for i in range(3)]
    data, arrays = encode_frame(frame)
    back = decode_frame(json.loads(json.dumps(data)), arrays)
    assert [int(o.vertices[0, 0]) for o in back.objects] == [0, 1, 2]  # type: ignore[index]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("camera.fx", float("nan")),
        ("camera.clip_end", float("inf")),
        ("camera.width", 3.5),
        ("camera.region", (1, 2, 3)),
        ("settings.denoise", "blur"),
        ("settings.seed", 2**64),
        ("settings.film_transparent", 1),
        ("world.environment", [[0.0]]),
        ("world.colour", (1.0, float("nan"), 1.0)),
        ("passes", ("Combined", 3)),
        ("objects", None),
    ],
)
def test_value_of_a_wrong_type_is_named(path, value):
    frame = full_frame()
    target = frame
    *parents, last = path.split(".")
    for name in parents:
        target = getattr(target, name)
    setattr(target, last, value)
    with pytest.raises(CodecError, match=last):
        encode_frame(frame)


@pytest.mark.parametrize("shared", [False, True])
def test_arrays_arrive_bit_by_bit(shared):
    link, pipe = loop(shared=shared)
    rng = np.random.default_rng(2)
    arrays = {
        "Combined": rng.normal(size=(5, 7, 4)).astype(np.float32),
        "empty": np.empty((0, 3), np.float32),
        "special": np.array([np.nan, -0.0, np.inf, 1e-45], np.float32),
        "double": rng.normal(size=(4, 4)),
        "bytes": np.arange(3, dtype=np.uint8),
        "strided": np.arange(24, dtype=np.int32).reshape(4, 6)[::2, ::3],
        "big-endian": np.arange(4, dtype=">f8"),
        "scalar": np.float32(3.5).reshape(()),
    }
    for _ in range(2):
        message = protocol.Result(4, ["careful"], {"seconds": 0.5})
        link.send(message, arrays)
        pipe.seek(0)
        received = link.receive()
        assert received is not None
        assert received[0] == message
        assert list(received[1]) == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(received[1][name], array, err_msg=name)
        pipe.seek(0)
        pipe.truncate()


def test_region_grows_and_falls_back_to_the_pipe_when_it_may_not():
    link, pipe = loop(shared=True)
    assert link.outgoing is not None
    link.outgoing.max_bytes = 4 << 20
    for size, inline in ((1 << 10, False), (3 << 20, False), (5 << 20, True)):
        pipe.seek(0)
        pipe.truncate()
        data = np.random.default_rng(size).integers(0, 255, size, np.uint8)
        link.send(protocol.Result(1, [], {}), {"a": data})
        assert (len(pipe.getvalue()) > size) == inline
        pipe.seek(0)
        received = link.receive()
        assert received is not None
        np.testing.assert_array_equal(received[1]["a"], data)


def test_end_between_messages_is_an_end_and_inside_one_is_an_error():
    whole = wire(header())
    assert receive(b"") is None
    assert receive(whole) is not None
    for cut in range(1, len(whole)):
        with pytest.raises(ProtocolError):
            receive(whole[:cut])


f4 = "<f4"


@pytest.mark.parametrize(
    "data",
    [
        wire(header(), magic=b"HTTP"),
        wire(header(), header=2**32 - 1),
        wire(header(), header=0),
        wire(header(), payload=2**63),
        wire(b"\xff\xfe{}"),
        wire(b"[" * 100_000),
        wire(b'{"a":' * 50_000),
        wire(b"1" * 10_000),
        wire(b'{"type":"Stopped","type":"Stopped","body":{"id":1},"where":"inline","arrays":[]}'),
        wire(b'{"type":"Progress","body":{"id":1,"phase":"","fraction":NaN},"where":"inline","arrays":[]}'),
        wire(b'{"type":"Progress","body":{"id":1,"phase":"","fraction":1e999},"where":"inline","arrays":[]}'),
        wire([]),
        wire({}),
        wire(header(extra=1)),
        wire(header(type="os.system")),
        wire(header(type=["Result"])),
        wire(header(body={"id": 1})),
        wire(header(body={"id": True, "warnings": [], "statistics": {}})),
        wire(header(body={"id": 1, "warnings": [], "statistics": {}, "more": 1})),
        wire(header(where="http://")),
        wire(header(where="shared", arrays=[["a", f4, [1], 0]])),
        wire(header(arrays={})),
        wire(header(arrays=[["a", "O", [1], 0]]), b"x" * 64),
        wire(header(arrays=[["a", "|V8", [1], 0]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [1] * 40, 0]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [-1], 0]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [True], 0]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [2**40], 0]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [2**33, 2**33, 2**33], 0]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [0, 2**33, 2**33, 2**33], 0]])),
        wire(header(arrays=[["a", f4, [1], 64]]), b"x" * 128),
        wire(header(arrays=[["a", f4, [1], -64]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [1], 0], ["b", f4, [1], 0]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [1], 0], ["a", f4, [1], 64]]), b"x" * 128),
        wire(header(arrays=[["a", f4, [1], 0]]), b"x" * 60),
        wire(header(arrays=[["a", f4, [16], 0]]), b"x" * 64, payload=4096),
        wire(header(arrays=[["a", f4, [1], 0, 1]]), b"x" * 64),
        wire(header(arrays=[["a", f4, [0], 0]] * 20_000)),
    ],
)
def test_malformed_messages_are_refused(data):
    with pytest.raises(ProtocolError):
        receive(data)


def test_shared_bulk_beyond_the_region_is_refused():
    link, pipe = loop(shared=True)
    pipe.write(wire(header(where="shared", arrays=[["a", f4, [1 << 20], 0]])))
    pipe.seek(0)
    with pytest.raises(ProtocolError, match="announced"):
        link.receive()


def test_mutated_messages_are_refused_or_read_and_nothing_else():
    link, pipe = loop()
    link.send(protocol.Render(3, *encode_frame(full_frame())[:1], {"a": 1}), {"a": np.zeros(5, np.float32)})  # type: ignore
    valid = pipe.getvalue()
    rng = random.Random(5)
    refused = 0
    for _ in range(600):
        data = bytearray(valid)
        for _ in range(rng.choice((1, 1, 2, 8))):
            place = rng.randrange(len(data))
            action = rng.randrange(3)
            if action == 0:
                data[place] = rng.randrange(256)
            elif action == 1:
                del data[place : place + rng.randrange(1, 40)]
            else:
                data[place:place] = data[rng.randrange(len(data)) :][: rng.randrange(1, 40)]
        try:
            received = receive(bytes(data))
            if received is not None and isinstance(received[0], protocol.Render):  # type: ignore[index]
                decode_frame(received[0].frame, {})  # type: ignore[index]
        except (ProtocolError, CodecError):
            refused += 1
    assert refused > 300


def test_only_new_content_is_sent_again():
    sender, receiver = SentSlots(), HeldSlots()
    a, b = np.zeros((4, 3), np.float32), np.ones(7)

    def exchange(arrays):
        versions, changed = sender.changes(arrays)
        held, missing = receiver.update(versions, {k: v.copy() for k, v in changed.items()})
        assert not missing
        assert all(np.array_equal(held[k], arrays[k], equal_nan=True) for k in arrays)
        return set(changed)

    assert exchange({"a": a, "b": b}) == {"a", "b"}
    assert exchange({"a": a.copy(), "b": b}) == set()
    a[2, 1] = np.nan
    assert exchange({"a": a, "b": b}) == {"a"}
    assert exchange({"a": a, "b": b}) == set()
    assert exchange({"a": a, "b": b.astype(np.float32)}) == {"b"}
    assert exchange({"a": a}) == set()
    assert exchange({"a": a, "b": b}) == {"b"}  # dropped when it vanished
    sender.forget()
    assert exchange({"a": a, "b": b}) == {"a", "b"}


def test_zero_sign_is_a_change_and_receiver_names_what_it_lacks():
    sender, receiver = SentSlots(), HeldSlots()
    sender.changes({"a": np.zeros(2)})
    versions, changed = sender.changes({"a": np.array([0.0, -0.0])})
    assert set(changed) == {"a"}
    assert receiver.update(versions, {}) == ({}, ["a"])


def test_older_content_of_a_slot_is_not_taken_for_the_one_that_is_named():
    receiver = HeldSlots()
    old, new = np.zeros(3), np.ones(3)
    assert receiver.update({"a": 1}, {"a": old})[1] == []
    assert receiver.update({"a": 2}, {}) == ({}, ["a"])  # the sender changed it, but the content never came
    held, missing = receiver.update({"a": 2}, {"a": new})
    assert missing == [] and held["a"] is new
    assert receiver.update({"a": 1}, {}) == ({}, ["a"])  # nor the other way round


def mapping_loop() -> tuple[Link, io.BytesIO]:
    """A `loop` that sends files of shareable arrays to itself."""
    if shared_file(frozen_shareable((SHARED_BYTES,), np.uint8)) is None:
        pytest.skip("this system has no anonymous shared memory")
    link, pipe = loop()
    ends = socket.socketpair()
    link.files = ends[0]
    link.peer = ends[1]  # type: ignore[attr-defined]
    return link, pipe


def frozen_shareable(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    array = shareable(shape, dtype)
    array[...] = np.arange(array.size).reshape(shape) % 251
    array.flags.writeable = False
    return array


def passed_on(link: Link, pipe: io.BytesIO, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    pipe.seek(0)
    pipe.truncate()
    link.send(protocol.Result(1, [], {}), arrays)
    pipe.seek(0)
    link.files, link.peer = link.peer, link.files  # type: ignore[attr-defined]
    try:
        return link.receive()[1]
    finally:
        link.files, link.peer = link.peer, link.files  # type: ignore[attr-defined]


def test_frozen_large_arrays_are_mapped_and_not_copied():
    """Both sides see the same memory; neither can write; it outlives the sender's array, and its file is closed."""
    link, pipe = mapping_loop()
    large, small = frozen_shareable((512, 513, 4), np.float32), np.arange(6, dtype=np.float32)
    expected, before = large.copy(), len(os.listdir("/proc/self/fd"))
    found = passed_on(link, pipe, {"large": large, "small": small, "again": frozen_shareable((1 << 20,), np.uint8)})
    assert link.bulk_sent < 1000 and frozen(found["large"]) and keep(found["large"]) is found["large"]
    assert shared_file(found["large"]) is None  # what was mapped is not passed on
    np.testing.assert_array_equal(found["small"], small)
    with pytest.raises(ValueError):
        found["large"].flags.writeable = True
    del large
    gc.collect()
    np.testing.assert_array_equal(found["large"], expected)
    del found
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= before - 1


def test_arrays_that_may_change_are_copied():
    """Writable ones, views and parts of shareable arrays are no files of their own."""
    whole = shareable((1 << 20,), np.float32)
    assert shared_file(whole) is None
    whole.flags.writeable = False
    for part in (whole[1:], whole.reshape(1024, 1024)[:, :512], whole.reshape(1024, 1024)):
        assert shared_file(part) is None
    link, pipe = mapping_loop()
    whole = shareable((1 << 20,), np.float32)
    found = passed_on(link, pipe, {"a": whole})["a"]
    whole[0] = 5.0
    assert found[0] == 0.0 and found.flags.writeable


def test_a_file_that_cannot_be_handed_over_ends_both_sides(monkeypatch):
    """The sender has an error, and the receiver, which waits for the file, another one."""
    link, pipe = mapping_loop()
    ends = link.files, link.peer  # type: ignore[attr-defined]

    def refuse(*_: object) -> int:
        raise OSError(errno.ETOOMANYREFS, "too many references")

    monkeypatch.setattr(socket, "send_fds", refuse)
    with pytest.raises(OSError, match="too many references"):
        link.send(protocol.Result(1, [], {}), {"large": frozen_shareable((1 << 20,), np.uint8)})
    pipe.seek(0)
    link.files = ends[1]
    ends[1].settimeout(10)
    with pytest.raises(ProtocolError, match="the file of array 'large' did not arrive"):
        link.receive()


def test_many_shareable_arrays_do_not_use_up_files():
    """And leave some for what is large."""
    kept = [shareable((SHARED_BYTES,), np.uint8) for _ in range(SHARED_FILES + 4)]
    assert sum(isinstance(array.base, SharedMemory) for array in kept) <= SHARED_FILES // 2
    large = shareable((LARGE_BYTES,), np.uint8)
    assert sys.platform != "linux" or isinstance(large.base, SharedMemory)
    for array in (*kept, large):
        array[:] = 1


@pytest.mark.parametrize("fault", ["no socket", "no file", "wrong size", "may shrink"])
def test_files_that_do_not_fit_are_refused(fault):
    link, pipe = mapping_loop()
    array = frozen_shareable((1 << 20,), np.uint8)
    message = header(files=[["a", "|u1", [(1 << 20) + (fault == "wrong size")], 0]])
    pipe.write(wire(message))
    pipe.seek(0)
    sender, link.files = link.files, link.peer  # type: ignore[attr-defined]
    if fault == "no socket":
        link.files = None
    elif fault == "no file":
        sender.send(b"\0")
    elif fault == "may shrink":
        fd = os.memfd_create("x", os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, 1 << 20)
        socket.send_fds(sender, [b"\0"], [fd])
        os.close(fd)
    else:
        socket.send_fds(sender, [b"\0"], [shared_file(array)])
    with pytest.raises(ProtocolError, match="array"):
        link.receive()
