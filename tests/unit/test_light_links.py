"""Light linking and shadow linking: who is lit, who throws shadows, at every vertex of a path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import sphere_mesh

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.frame import Camera, Frame, Light, MeshState, ObjectState, RenderSettings, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.render import pipeline

Scene = tuple[Session, Frame]
DARK = World(colour=(0.0, 0.0, 0.0))
NAMES = ("Combined", "IndexOB", "DiffDir")


def at(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def slab(name: str, number: int, x: float, z: float, half: float, **more: object) -> MeshState:
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    material = Material(name, (0.8, 0.8, 0.8), 1.0, 0.0, more.pop("emission", (0.0, 0.0, 0.0)))  # type: ignore[arg-type]
    return MeshState(
        name, corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), at(x, 0, z)[None], np.array([number], np.int32),
        materials=[material], **more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Left a slab, right a ball of surfels, a screen above either, and two lamps; seen from above."""
    vertices, faces = sphere_mesh(2)
    n = len(vertices)
    mesh = Mesh(0.6 * vertices, faces, np.full((n, 3), 0.8), np.full(n, 1.0), np.zeros(n))
    surfels, binding, _ = attach(mesh)
    path = tmp_path_factory.mktemp("asset") / "ball.drgs"
    write_asset(path, Asset(surfels, mesh, binding))
    session = Session()
    ball = ObjectState("ball", session.load_asset(path), at(1, 0, 0), pass_index=2)
    left = slab("left", 1, -1, 0, 0.7)
    above = slab("screen", 3, 0, 1.5, 0.9, visibility=Visibility(camera=False))
    lamps = [
        Light("key", "point", at(0, 0, 3), power=300.0, radius=0.2),
        Light("fill", "area", at(0, -2.5, 2.5), power=100.0, size_x=1.0),
    ]
    camera = Camera(at(0, 0, 6), 40, 20, 10.0, 10.0, 20.0, 10.0, orthographic=True)
    settings = RenderSettings(samples=16, subpixel_samples=4, bounces=0, camera_sees="mesh")
    return session, Frame(0, camera, [ball], DARK, settings, NAMES, [left, above], lamps)


def rendered(scene: Scene, **changes: object) -> tuple[np.ndarray, np.ndarray]:
    """Picture and pass indices."""
    session, frame = scene
    passes = session.render(replace(frame, **changes))
    return passes["Combined"][..., :3], passes["IndexOB"][..., 0]


def with_bits(frame: Frame, who: str, **bits: int) -> dict[str, object]:
    """Objects and meshes of a frame, `who` with these bits of its visibility."""
    objects = [replace(o, visibility=replace(o.visibility, **bits)) if o.name == who else o for o in frame.objects]
    meshes = [replace(m, visibility=replace(m.visibility, **bits)) if m.name == who else m for m in frame.meshes]
    return {"objects": objects, "meshes": meshes}


@pytest.mark.parametrize("rays_see", ["mesh", "surfels"])
@pytest.mark.parametrize("sees", ["mesh", "surfels"])
def test_a_linked_light_is_there_for_its_receivers_alone(scene: Scene, rays_see: str, sees: str) -> None:
    """The others look as if there were no such light, to the noise that other samples bring."""
    frame = replace(scene[1], meshes=scene[1].meshes[:1])
    settings = replace(frame.settings, rays_see=rays_see, camera_sees=sees, samples=64)
    key, fill = frame.lights
    linked, index = rendered(
        scene, settings=settings, lights=[replace(key, receivers=0), fill], **with_bits(frame, "ball", lit_by=1)
    )  # fmt: skip
    both, _ = rendered(scene, settings=settings, meshes=frame.meshes)
    without, _ = rendered(scene, settings=settings, lights=[fill], meshes=frame.meshes)
    ball, slab_ = index == 2, index == 1
    assert ball.sum() > 80 and slab_.sum() > 150
    for region, expected in ((ball, both), (slab_, without)):
        assert linked[region].mean() == pytest.approx(expected[region].mean(), rel=0.02)
    assert both[ball].mean() > 1.3 * without[ball].mean()


def test_links_of_nothing_change_no_sample(scene: Scene) -> None:
    """Lights without links, in a frame whose objects have bits, are not linked at all."""
    _, frame = scene
    plain, _ = rendered(scene)
    marked, _ = rendered(scene, **with_bits(frame, "ball", lit_by=5, blocks=3))
    assert np.array_equal(plain, marked)


def test_indirect_light_is_linked_at_every_vertex(scene: Scene) -> None:
    """Light that reaches the ball by the slab alone: gone when the slab is not lit, not when the ball is not."""
    _, frame = scene
    settings = replace(frame.settings, bounces=2, samples=256)
    low = replace(frame.lights[0], matrix_world=at(-0.6, 0, 0.6), power=30.0, receivers=0)
    meshes = [frame.meshes[0]]
    by_slab = {"settings": settings, "lights": [low]}
    found = {}
    for who in ("left", "ball"):
        bits = with_bits(replace(frame, meshes=meshes), who, lit_by=1)
        picture, index = rendered(scene, **by_slab, **bits)
        found[who] = picture[index == 2].mean(), picture[index == 1].mean()
    everything, index = rendered(scene, settings=settings, lights=[replace(low, receivers=-1)], meshes=meshes)
    straight = replace(settings, bounces=0)
    direct, _ = rendered(scene, settings=straight, lights=[replace(low, receivers=-1)], meshes=meshes)
    # The slab is lit: the ball gets what the slab reflects, not the lamp's own light.
    indirect = everything[index == 2].mean() - direct[index == 2].mean()
    assert indirect > 0
    assert found["left"][0] == pytest.approx(indirect, rel=0.1)
    # The ball is lit: the slab gets only what the ball reflects.
    assert found["ball"][1] < 0.3 * everything[index == 1].mean() and found["ball"][0] > found["left"][0]


@pytest.mark.parametrize("sized", [True, False])
def test_shadow_linking_lets_light_through_others(scene: Scene, sized: bool) -> None:
    """The screen hides the lamp from both; a lamp that only the ball throws a shadow of shines through the screen."""
    _, frame = scene
    lamp = replace(frame.lights[0], radius=0.2 if sized else 0.0)
    settings = replace(frame.settings, samples=64)
    hidden, index = rendered(scene, lights=[lamp], settings=settings)
    clear, _ = rendered(scene, lights=[lamp], meshes=[frame.meshes[0]], settings=settings)
    through, _ = rendered(
        scene, lights=[replace(lamp, blockers=0)], settings=settings, **with_bits(frame, "ball", blocks=1)
    )  # fmt: skip
    blocked, _ = rendered(
        scene, lights=[replace(lamp, blockers=0)], settings=settings, **with_bits(frame, "screen", blocks=1)
    )  # fmt: skip
    inner = index == 1
    assert hidden[inner].mean() < 0.5 * clear[inner].mean()
    assert through[inner].mean() == pytest.approx(clear[inner].mean(), rel=0.02)
    assert blocked[inner].mean() == pytest.approx(hidden[inner].mean(), rel=0.03, abs=1e-4)


@pytest.mark.parametrize("rays_see", ["mesh", "surfels"])
def test_glowing_meshes_are_linked(scene: Scene, rays_see: str) -> None:
    """As a lamp, found by light samples and by the rays of lobes; unlinked rest of the scene is as without it."""
    _, frame = scene
    glow = slab("glow", 4, 0, 2.0, 0.5, emission=(6.0, 6.0, 6.0), visibility=Visibility(camera=False, shadow=False))
    settings = replace(frame.settings, samples=64, rays_see=rays_see)
    meshes = [frame.meshes[0], glow]
    lit, index = rendered(scene, lights=[], meshes=meshes, settings=settings)
    linked = [frame.meshes[0], replace(glow, receivers=0)]
    bits = with_bits(replace(frame, meshes=linked), "left", lit_by=1)
    found, _ = rendered(scene, lights=[], settings=settings, **bits)
    assert found[index == 2].max() == 0
    assert found[index == 1].mean() == pytest.approx(lit[index == 1].mean(), rel=0.02)
    blocked = [*meshes[:1], replace(glow, blockers=0), replace(frame.meshes[1], visibility=Visibility(camera=False))]
    through, _ = rendered(scene, lights=[], meshes=blocked, settings=settings)
    assert through[index == 1].mean() == pytest.approx(lit[index == 1].mean(), rel=0.03)


#: Cosine, GGX and light samples.
STRATEGIES = {"auto": None, "lobes": (16, 64, 0), "lights": (0, 0, 80), "all": (16, 48, 16)}
#: Lamps that not everything blocks.
UNBLOCKED: dict[str, dict[str, int]] = {"linked": {"blockers": 0}, "without shadow": {"cast_shadow": False}}


def glossy(rough: float, screen: bool = True, **more: object) -> list[MeshState]:
    """A slab of metal under a screen that the camera does not see."""
    meshes = [slab("left", 1, -1, 0, 0.7, **more), slab("screen", 3, 0, 1.5, 0.9, visibility=Visibility(camera=False))]
    meshes[0].materials[0].roughness, meshes[0].materials[0].metallic = rough, 1.0
    return meshes if screen else meshes[:1]


def test_shadow_linking_to_everything_changes_no_sample(scene: Scene) -> None:
    """A lamp whose shadow all objects throw is the lamp without links: for light samples and for rays of lobes."""
    session, frame = scene
    settings = replace(frame.settings, samples=64, bounces=1)
    meshes, lamps = glossy(0.3), [replace(frame.lights[0], radius=0.8), frame.lights[1]]
    plain, index = rendered(scene, meshes=meshes, lights=lamps, settings=settings)
    frame = replace(frame, meshes=meshes, lights=[replace(lamp, blockers=2) for lamp in lamps])
    changes = with_bits(frame, "ball", blocks=4)
    for who in ("left", "screen"):
        changes = with_bits(replace(frame, **changes), who, blocks=4)
    linked, _ = rendered((session, frame), settings=settings, **changes)
    assert plain[index == 1].mean() > 0.02
    np.testing.assert_allclose(linked, plain, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("change", UNBLOCKED)
def test_whichever_strategy_finds_a_lamp_it_is_as_bright(scene: Scene, change: str, strategy: str) -> None:
    """Where nothing is in front of it: in a rough mirror, with shadow linking or without a shadow, as others are."""
    _, frame = scene
    lamp = replace(frame.lights[0], radius=0.8)
    settings = replace(frame.settings, samples=256, strategy_samples=STRATEGIES[strategy])
    plain = replace(frame.settings, samples=256)
    bare, index = rendered(scene, meshes=glossy(0.3, False), lights=[lamp], settings=plain)
    assert bare[index == 1].mean() > 0.5
    free, _ = rendered(scene, meshes=glossy(0.3, False), lights=[replace(lamp, **UNBLOCKED[change])], settings=settings)
    assert free[index == 1].mean() == pytest.approx(bare[index == 1].mean(), rel=0.02)


@pytest.mark.parametrize("strategy", ["auto", "lobes", "all"])
def test_whichever_strategy_finds_a_glowing_mesh_it_is_as_bright(scene: Scene, strategy: str) -> None:
    _, frame = scene
    settings = replace(frame.settings, samples=256, strategy_samples=STRATEGIES[strategy])
    glow = slab("glow", 4, 0, 2.0, 0.8, emission=(6.0, 6.0, 6.0), visibility=Visibility(camera=False))
    bare, index = rendered(scene, meshes=[*glossy(0.3, False), glow], lights=[], settings=settings)
    assert bare[index == 1].mean() > 0.5
    linked = [*glossy(0.3, False), replace(glow, blockers=0)]
    found, _ = rendered(scene, meshes=linked, lights=[], settings=settings)
    assert found[index == 1].mean() == pytest.approx(bare[index == 1].mean(), rel=0.03)


@pytest.mark.parametrize("change", UNBLOCKED)
def test_mirrors_show_what_is_in_front_of_a_lamp_that_it_does_not_block(scene: Scene, change: str) -> None:
    """Behind the screen the lamp lights what is rough in full, and is not in mirrors."""
    _, frame = scene
    settings = replace(frame.settings, samples=256)
    lamp = replace(frame.lights[0], radius=0.4)
    seen = {}
    for rough in (0.03, 0.3, 1.0):
        bare, index = rendered(scene, meshes=glossy(rough, False), lights=[lamp], settings=settings)
        behind, _ = rendered(
            scene, meshes=glossy(rough), lights=[replace(lamp, **UNBLOCKED[change])], settings=settings
        )
        assert bare[index == 1].mean() > 0.05
        seen[rough] = behind[index == 1].mean() / bare[index == 1].mean()
    assert seen[1.0] == pytest.approx(1.0, abs=0.02) and seen[0.03] < 0.5 and seen[0.03] < seen[0.3] < seen[1.0]
    blocked = with_bits(replace(frame, meshes=glossy(0.3)), "screen", blocks=1)
    dark, index = rendered(scene, lights=[replace(lamp, blockers=0)], settings=settings, **blocked)
    assert dark[index == 1].mean() < 0.5 * seen[0.3]


def test_threads_and_strips_do_not_change_a_bit(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    _, frame = scene
    key, fill = frame.lights
    changes = {"lights": [replace(key, receivers=0, blockers=1), replace(fill, receivers=1)]}
    changes |= with_bits(frame, "ball", lit_by=3, blocks=2)
    whole, _ = rendered(scene, **changes)
    monkeypatch.setattr(pipeline, "strip_height", lambda width, subpixels: 3)
    again, _ = rendered(scene, **changes)
    assert np.array_equal(whole, again)
