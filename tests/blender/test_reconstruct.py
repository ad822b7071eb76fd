"""Photographs to an object: the real program, in a process of its own."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from scenes import part

reconstruction, operator = part("addon.reconstruction"), part("operators.reconstruct")
dialog = part("operators.reconstruct_fields")
#: Fields that say nothing.
SILENT = dict.fromkeys(dialog._NUMBERS, 0) | dialog.ReconstructFields.defaults
SILENT |= {"variant": "p", "axes": "opengl", "use_materials": True, "mask_model": ""}
SIZE, FOCAL = 32, 40.0


def png(path, pixels):
    """Write (h, w, 4) sRGB values in 0..1, top row first."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(path.stem, width, height, alpha=True)
    image.alpha_mode = "STRAIGHT"
    image.pixels.foreach_set(np.ascontiguousarray(pixels[::-1], np.float32).ravel())
    image.file_format, image.filepath_raw = "PNG", str(path)
    image.save()
    bpy.data.images.remove(image)


@pytest.fixture
def photographs(tmp_path):
    """A folder with photographs of the unit sphere, coloured by position, and their cameras."""
    folder = tmp_path / "Sphere"
    folder.mkdir()
    frames = []
    for k, angle in enumerate(np.arange(8) * np.pi / 4):
        back = np.array([np.cos(angle), np.sin(angle), 0.5 - k % 2])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([right, np.cross(back, right), back, 4 * back])
        y, x = (np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2) / FOCAL
        rays = np.stack([x, -y, -np.ones_like(x)], -1) @ matrix[:3, :3].T
        a, b = (rays**2).sum(-1), rays @ matrix[:3, 3]
        root = b * b - a * 15
        points = matrix[:3, 3] + ((-b - np.sqrt(np.maximum(root, 0))) / a)[..., None] * rays
        png(folder / f"{k}.png", np.dstack([np.clip(0.5 + 0.4 * points, 0, 1), root > 0]))
        frames.append({"file_path": f"{k}", "transform_matrix": matrix.tolist()})
    text = json.dumps({"camera_angle_x": 2 * np.arctan(SIZE / 2 / FOCAL), "frames": frames})
    (folder / "transforms.json").write_text(text)
    return folder


@pytest.mark.slow
def test_photographs_become_an_object(scene, photographs, tmp_path):
    assert bpy.ops.drgs.reconstruct(filepath=str(photographs), minutes=0.1, use_environment=True) == {"FINISHED"}
    obj = bpy.context.active_object
    assert obj.name == "Sphere" and obj.drgs.is_drgs and reconstruction.job is None
    points = np.array([v.co for v in obj.data.vertices])
    assert abs(np.median(np.linalg.norm(points, axis=1)) - 1) < 0.15
    assert part("addon.assets").load(tmp_path / "Sphere.drgs").environment is not None
    assert scene.world is not None and scene.world.name.startswith("Sphere")
    assert not (tmp_path / "Sphere.reconstruct").exists()
    said = [message.text for message in part("addon.messages").history]
    assert not any("DRGS_" in text for text in said)
    # The preview that the panel shows is the one that the program left.
    state = reconstruction.Reconstruction(tmp_path / "Sphere.drgs", photographs)
    assert state.icon() == state.icon()
    (preview,) = reconstruction._previews.values()
    assert preview.image_size[0] == 2 * preview.image_size[1]


@pytest.mark.slow
def test_without_a_window_the_terminal_shows_how_far_it_is(scene, photographs, monkeypatch, capsys):
    monkeypatch.setattr(part("operators.engine_command"), "_REPORT_EVERY", 0.2)
    assert bpy.ops.drgs.reconstruct(filepath=str(photographs), minutes=0.1, use_materials=False) == {"FINISHED"}
    said = capsys.readouterr().out
    lines = [line for line in said.splitlines() if line.startswith('Capture "Sphere": ')]
    assert len(lines) > 1 and any("Surfels, " in line for line in lines)
    assert all(line != following for line, following in pairwise(lines))
    assert "surfels on" in said.split(lines[-1])[1] and "DRGS_" not in said


@pytest.mark.parametrize(
    ("name", "value", "given"),
    [
        ("resolution", 0, None),
        ("resolution", 5, "capture.resolution=8"),
        ("resolution", 9, "capture.resolution=9"),
        ("test_every", 1, None),
        ("test_every", 2, "capture.test_every=2"),
        ("surfels", 1, "schedule.surfels=10"),
        ("voxels", 15, "mesh_resolution=16"),
        ("voxels", 17, "mesh_resolution=17"),
        ("iterations", 1, "schedule.iterations=1"),
        ("minutes", 0.0001, "minutes=0.001"),
        ("minutes", 2.5, "minutes=2.5"),
        ("video_frames", 3, "capture.video_frames=10"),
        ("marker_length", 29.4, "capture.marker_length=29.4"),
        ("camera_distance", 0.0, None),
        ("camera_distance", 2.5, "capture.camera_distance=2.5"),
        ("masks", "none", "capture.masks=none"),
        ("poses", "markers", "capture.poses=markers"),
        ("brackets", "3", "capture.brackets=3"),
    ],
)
def test_small_numbers_of_the_dialog_are_the_least_there_are(name, value, given):
    options = dialog.options_of(SimpleNamespace(**SILENT | {name: value}))
    assert options[4:] == ([] if given is None else ["--set", given])


def test_a_model_of_masks_is_a_file_or_a_name_and_needs_one(tmp_path):
    """A file by its whole path, as the program runs elsewhere; a name as rembg gives it."""
    (file := tmp_path / "mine.onnx").touch()
    for named, given in ((str(file), str(file)), ("isnet-general-use", "isnet-general-use")):
        fields = SimpleNamespace(**SILENT | {"masks": "model", "mask_model": named})
        assert dialog.options_of(fields)[4:] == ["--set", f"capture.masks={given}"]
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match="no model is given"):
        dialog.options_of(SimpleNamespace(**SILENT | {"masks": "model"}))


def test_fields_of_photographs_without_cameras_are_those_that_matter(tmp_path):
    def names(capture, **values):
        return dialog.without_cameras(SimpleNamespace(**SILENT | values), str(capture))

    for name in ("transforms.json", "walk.MP4"):
        (tmp_path / name).touch()
    assert names("") == names(tmp_path) == list(dialog._WITHOUT_CAMERAS)
    assert names(tmp_path / "transforms.json") == []
    assert "brackets" not in names(tmp_path / "walk.MP4") and "video_frames" in names(tmp_path / "walk.MP4")
    assert "camera_distance" not in names("", poses="markers") and "marker_length" not in names("", poses="features")
    # What is not shown is not given.
    fields = SimpleNamespace(**SILENT | {"video_frames": 50, "brackets": "3"})
    assert dialog.options_of(fields, str(tmp_path / "transforms.json"))[4:] == []
    assert dialog.options_of(fields, str(tmp_path / "walk.MP4"))[4:] == ["--set", "capture.video_frames=50"]


class Operator(part("operators.engine_command").CommandOperator):
    """Remembers what it reports."""

    def __init__(self):
        self.said = []

    def report(self, kinds, text):
        self.said.append((*kinds, text))


def test_warnings_of_the_program_are_told_as_they_appear_each_once_and_its_error_is_not_among_them(monkeypatch):
    messages, program = part("addon.messages"), part("operators.engine_command")
    messages.clear()
    one, tick = Operator(), SimpleNamespace(type="TIMER")
    one._process = SimpleNamespace(poll=lambda: None)
    output = "a note\ndrgs: walk: scale is guessed\n"
    monkeypatch.setattr(program.CommandOperator, "_read_output", lambda self, last=False: output)
    one.modal(bpy.context, tick)
    assert not one.said  # it may be the error of a program that has just ended
    output += 'DRGS_PROGRESS part=0.1 surfels=0 phase="surfels"\n'
    one.modal(bpy.context, tick)
    one.modal(bpy.context, tick)
    assert one.said == [("WARNING", "walk: scale is guessed")]
    assert [m.level for m in messages.history] == ["WARNING"]
    output += "drgs: walk: 2 masks are doubtful\ndrgs: walk: cannot be calibrated.\nsome line at last\n"
    one._process = SimpleNamespace(returncode=65)
    one._subject, one._failure = "Capture", "could not be reconstructed"
    with pytest.raises(part("drgs_blender.core.errors").AssetError, match="reconstructed: walk: cannot be calibrated"):
        one._finish(bpy.context)
    assert [text for _, text in one.said] == ["walk: scale is guessed", "walk: 2 masks are doubtful"]
    # Of a program that has succeeded all are warnings, and other lines are not.
    one._process = SimpleNamespace(returncode=0)
    messages.clear()
    assert one._finish(bpy.context) == {"FINISHED"}
    assert one.said[2:] == [("WARNING", "walk: cannot be calibrated.")]
    assert [(m.level, m.text) for m in messages.history][1:] == [("INFO", "a note"), ("INFO", "some line at last")]


def test_pictures_and_doubts_of_a_reconstruction_can_be_shown(scene, tmp_path, monkeypatch):
    """Only those that there are, and those of the folder of a capture only where `drgs capture` made it."""
    out, folder = tmp_path / "walk.drgs", tmp_path / "walk.capture"
    folder.mkdir()
    run = reconstruction.Reconstruction(out, folder)
    grey = np.full((4, 6, 4), 0.5)
    for name in ("masks", "capture"):
        png(folder / f"{name}.png", grey)
    assert not reconstruction.Made(run, ()).pictures
    (folder / "capture.json").touch()
    made = reconstruction.Made(run, ["walk: 2 masks are doubtful", "walk: scale is guessed"])
    assert made.pictures == {"Masks": folder / "masks.png", "Cameras": folder / "capture.png"}
    assert made.doubts == ["walk: 2 masks are doubtful"]
    png(tmp_path / "walk.masks.png", grey)
    made = reconstruction.Made(run, ())
    assert made.pictures["Masks"] == tmp_path / "walk.masks.png"
    area = bpy.context.window_manager.windows[0].screen.areas[0]
    before = area.ui_type
    area.ui_type = "IMAGE_EDITOR"
    try:
        assert bpy.ops.drgs.reconstruct_show(filepath=str(made.pictures["Masks"])) == {"FINISHED"}
        shown = area.spaces.active.image
        assert Path(bpy.path.abspath(shown.filepath)) == tmp_path / "walk.masks.png" and tuple(shown.size) == (6, 4)
    finally:
        area.ui_type = before
    with pytest.raises(RuntimeError, match="cannot be read"):
        bpy.ops.drgs.reconstruct_show(filepath=str(tmp_path / "none.png"))
    # In the panel: beside the object that was made, and no other.
    panel = part("addon.panels.workflow")
    monkeypatch.setattr(reconstruction, "made", made)
    for path, expected in ((out, ["Show Masks", "Show Cameras"]), (tmp_path / "other.drgs", [])):
        obj = SimpleNamespace(drgs=SimpleNamespace(asset=SimpleNamespace(filepath=str(path))))
        monkeypatch.setattr(panel.workflow, "target", lambda _, obj=obj: obj)
        panel._made(Layout(texts := []), bpy.context)
        assert texts == expected


@pytest.mark.parametrize("cameras", [False, True])
def test_what_was_made_is_there_with_its_cameras_where_they_are_wanted(scene, photographs, monkeypatch, cameras):
    """The end of a run alone, of a capture whose cameras were found in a folder of their own."""
    asked = []
    monkeypatch.setattr(operator, "import_assets", lambda *words: asked.append(words[1]))
    monkeypatch.setattr(reconstruction, "made", None)
    found = photographs.with_name("walk.capture")
    photographs.rename(found)
    job = reconstruction.Reconstruction(photographs.with_name("walk.drgs"), photographs.with_name("walk.mp4"))
    monkeypatch.setattr(reconstruction, "job", job)
    for name in ("masks", "capture"):
        png(found / f"{name}.png", np.full((4, 6, 4), 0.5))
    (found / "capture.json").touch()
    camera = scene.camera
    one = SimpleNamespace(
        _output=f"DRGS_CAPTURE {found}\n", _warned=("a mask is empty",), use_environment=False, use_cameras=cameras,
        axes="opengl",
    )  # fmt: skip
    assert operator.DRGS_OT_reconstruct.done(one, bpy.context) == {"FINISHED"}
    assert asked == [[job.out]] and reconstruction.made.doubts == ["a mask is empty"]
    loaded = {Path(bpy.path.abspath(image.filepath)).name for image in bpy.data.images}
    assert {"masks.png", "capture.png"} <= loaded
    collections = [c for c in scene.collection.children if c.name.startswith("Cameras of walk.capture")]
    assert len(collections) == cameras and (not cameras or len(collections[0].objects) == 8)
    assert camera is None or scene.camera is camera


def test_a_video_gives_its_name_to_the_asset_and_needs_what_finds_cameras(scene, tmp_path, monkeypatch):
    """Two videos of a folder have each their own work."""
    link, started = part("addon.engine_link"), []
    program = part("operators.engine_command").CommandOperator

    def start(self, context, arguments, subject, *_):
        self.clear()
        started.append((arguments[arguments.index("--out") + 1], subject))
        return {"FINISHED"}

    monkeypatch.setattr(program, "start", start)
    for name in ("first.mp4", "second.MOV"):
        (tmp_path / name).touch()
        assert bpy.ops.drgs.reconstruct(filepath=str(tmp_path / name)) == {"FINISHED"}
    folder = Path(bpy.data.filepath).parent
    assert started == [
        (str(folder / "first.drgs"), 'Capture "first"'), (str(folder / "second.drgs"), 'Capture "second"')
    ]  # fmt: skip
    monkeypatch.setattr(link, "lacks_capture", lambda: True)
    with pytest.raises(RuntimeError, match="Set Up Engine with Photographs without Cameras"):
        bpy.ops.drgs.reconstruct(filepath=str(tmp_path / "first.mp4"))
    with pytest.raises(RuntimeError, match="Set Up Engine with Photographs without Cameras"):
        bpy.ops.drgs.print_markers(filepath=str(tmp_path / "sheet.pdf"))
    assert len(started) == 2


def test_folders_without_cameras_are_told_from_those_with(photographs):
    assert not operator._has_no_cameras(photographs, "opengl")
    (photographs / "transforms.json").unlink()
    assert operator._has_no_cameras(photographs, "opengl")
    assert not operator._has_no_cameras(photographs.with_name("absent"), "opengl")


def test_a_marker_sheet_is_written(scene, tmp_path):
    assert bpy.ops.drgs.print_markers(filepath=str(tmp_path / "sheet"), paper="a3") == {"FINISHED"}
    assert (tmp_path / "sheet.pdf").read_bytes().startswith(b"%PDF")
    assert "297 x 420 mm" in part("addon.messages").history[-1].text


def test_lines_end_alike_on_all_systems(monkeypatch):
    link = part("addon.engine_link")
    monkeypatch.setattr(link, "drgs_command", lambda: ["drgs"])
    done = SimpleNamespace(returncode=0, stdout=b"[capture]\r\nup = 1\r\n")
    monkeypatch.setattr(link.subprocess, "run", lambda *_, **__: done)
    assert link.output_of(["reconstruct"]) == "[capture]\nup = 1\n"


def test_progress_is_what_the_program_says(tmp_path):
    state = reconstruction.Reconstruction(tmp_path / "a.drgs", tmp_path / "photographs")
    state.follow("drgs: a note\n")
    assert state.part == 0 and not state.icon()
    state.follow('DRGS_PROGRESS part=0.1 surfels=9 psnr=20.5 phase="surfels"\nDRGS_PROGRESS part=0.25 surfels=12')
    assert state.part == 0.1 and state.text == "Surfels, 20.5 dB"
    state.follow('DRGS_PROGRESS part=0.5 surfels=12000 phase="mesh"\n')
    assert state.part == 0.5 and state.text == "Mesh, 12,000 surfels"
    assert state.capture == tmp_path / "photographs"
    state.follow('DRGS_CAPTURE /x/my walk.capture\nDRGS_PROGRESS part=0.5 surfels=12000 phase="mesh"\n')
    assert str(state.capture) == str(Path("/x/my walk.capture"))


@pytest.mark.slow
def test_what_is_no_capture_is_said(scene, tmp_path):
    with pytest.raises(RuntimeError, match="is not there"):
        bpy.ops.drgs.reconstruct(filepath=str(tmp_path / "none"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(RuntimeError, match=r'"empty".*could not be reconstructed'):
        bpy.ops.drgs.reconstruct(filepath=str(tmp_path / "empty"))
    assert reconstruction.job is None


@pytest.mark.slow
def test_the_convention_that_a_message_names_can_be_chosen(scene, photographs):
    """Matrices of OpenCV: refused with the name of the choice, which is one of the operator's and then serves."""
    choices = bpy.ops.drgs.reconstruct.get_rna_type().properties["axes"].enum_items
    titles = {"opengl": "Automatic", "opencv": "OpenCV", "opengl-inverse": "OpenGL, Inverse"}
    assert {item.identifier: item.name for item in choices} == titles | {"opencv-inverse": "OpenCV, Inverse"}
    assert choices["opencv"].description == "Camera to world, y down, z forward"
    file = photographs / "transforms.json"
    capture = json.loads(file.read_text())
    for frame in capture["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])).tolist()
    file.write_text(json.dumps(capture))
    with pytest.raises(RuntimeError, match="--axes opencv"):
        bpy.ops.drgs.reconstruct(filepath=str(photographs), minutes=0.1, use_materials=False)
    done = bpy.ops.drgs.reconstruct(filepath=str(photographs), minutes=0.1, use_materials=False, axes="opencv")
    assert done == {"FINISHED"} and bpy.context.active_object.drgs.is_drgs


class Window(SimpleNamespace):
    """A window manager and a workspace that remember what was asked of them."""

    def __init__(self) -> None:
        texts: list = []
        manager = SimpleNamespace(
            windows=[], event_timer_add=lambda *_, **__: "timer", event_timer_remove=lambda _: None,
            modal_handler_add=lambda _: None,
        )  # fmt: skip
        super().__init__(
            texts=texts,
            scene=bpy.context.scene,
            window=object(),
            window_manager=manager,
            workspace=SimpleNamespace(status_text_set=texts.append),
        )


def test_it_works_beside_the_window_until_cancelled(scene, photographs, tmp_path, monkeypatch):
    """The operator's own steps, on a window that stands in for Blender's: there is none in the background."""
    program = part("operators.engine_command")
    monkeypatch.setattr(program, "bpy", SimpleNamespace(app=SimpleNamespace(background=False), types=bpy.types))
    context = Window()
    cls = operator.DRGS_OT_reconstruct
    own = {name: value for name, value in vars(cls).items() if not name.startswith(("__", "bl_"))}
    stand_in = type("StandIn", (program.CommandOperator,), own)()
    values = {"filepath": str(photographs), "out": "", "minutes": 5.0, "resolution": 0, "variant": "p"}
    values = SILENT | values | {"use_environment": False, "use_cameras": False, "settings": "", "config": ""}
    for name, value in values.items():
        setattr(stand_in, name, value)
    scene.drgs.device = "CUDA"
    assert stand_in.run(context) == {"RUNNING_MODAL"}
    process = stand_in._process
    assert "minutes=5" in process.args
    assert process.args[process.args.index("--device") + 1] == "cuda"
    tick, escape = SimpleNamespace(type="TIMER"), SimpleNamespace(type="ESC")
    assert stand_in.modal(context, tick) == {"PASS_THROUGH"} and not cls.poll(context)
    assert stand_in.modal(context, escape) == {"PASS_THROUGH"} and process.poll() is None
    assert "Reading the photographs" in context.texts[-1]
    assert bpy.ops.drgs.reconstruct_cancel() == {"FINISHED"}
    assert stand_in.modal(context, tick) == {"CANCELLED"}
    assert process.poll() is not None and reconstruction.job is None and context.texts[-1] is None


def test_new_settings_are_a_text_with_what_the_fields_say_and_that_text_is_used(scene, photographs, monkeypatch):
    """In the background there is no dialog: its fields are those of a stand-in."""
    texts = set(bpy.data.texts)
    assert bpy.ops.drgs.reconstruct_settings() == {"FINISHED"}
    (text,) = set(bpy.data.texts) - texts
    said = text.as_string()
    assert (
        "[schedule]" in said and "[decoupling]" in said and "iterations = 3000 " in said and "grey_light_prior" in said
    )
    values = dict(
        bl_idname="DRGS_OT_reconstruct", minutes=0.25, resolution=64, surfels=900, voxels=40, variant="m",
        iterations=10_000_000, axes="opencv", use_materials=False, masks="none", brackets="3", settings="", config="",
    )  # fmt: skip
    fields = SimpleNamespace(**SILENT | values)
    cls = operator.DRGS_OT_reconstruct_settings
    assert cls.run(SimpleNamespace(), SimpleNamespace(space_data=SimpleNamespace(active_operator=fields))) == {
        "FINISHED"
    }
    said = bpy.data.texts[fields.settings].as_string()
    for line in (
        "minutes = 0.25 ",
        "surfels = 900 ",
        "iterations = 10000000 ",
        "mesh_resolution = 40 ",
        "test_every = ",
    ):
        assert line in said
    assert 'masks = "none" ' in said and 'brackets = "3" ' in said
    assert 'variant = "m" ' in said and "materials = false " in said and 'axes = "opencv" ' in said
    # A text that cannot be used is refused by its name and what is wrong in it.
    bpy.data.texts[fields.settings].from_string("[schedule]\niteration = 3")
    with pytest.raises(RuntimeError, match=r"toml, schedule.iteration: .*the nearest is schedule.iterations"):
        bpy.ops.drgs.reconstruct(filepath=str(photographs), settings=fields.settings)
    with pytest.raises(RuntimeError, match=r'Text "none": is not in this \.blend'):
        bpy.ops.drgs.reconstruct(filepath=str(photographs), settings="none")
    with pytest.raises(RuntimeError, match="Leave one of them out"):
        bpy.ops.drgs.reconstruct(filepath=str(photographs), settings=text.name, config="//a.toml")
    assert reconstruction.job is None
    before = set(bpy.data.texts)
    monkeypatch.setattr(part("addon.engine_link"), "command_line", lambda: ["/nowhere/python", "-m", "drgs"])
    with pytest.raises(RuntimeError, match="does not answer"):
        bpy.ops.drgs.reconstruct_settings()
    assert set(bpy.data.texts) == before


class Layout:
    """A layout that knows which properties and operators it is asked to show."""

    def __init__(self, shown, opened=True):
        self.shown, self.opened = shown, opened

    def column(self, **_):
        return Layout(self.shown, self.opened)

    row = column

    def panel(self, *_, **__):
        return Layout(self.shown), Layout(self.shown) if self.opened else None

    def prop(self, owner, name, **_):
        assert hasattr(owner, name)
        self.shown.append(name)

    def prop_search(self, owner, name, *_):
        self.prop(owner, name)

    def operator(self, name, text="", **_):
        assert hasattr(bpy.ops.drgs, name.removeprefix("drgs."))
        if text:
            self.shown.append(text)
        return SimpleNamespace()

    def label(self, **_):
        pass


@pytest.mark.parametrize("opened", [False, True])
@pytest.mark.parametrize("masks", ["given", "model"])
def test_the_dialog_shows_every_field_once_and_the_advanced_ones_where_they_are_opened(opened, masks):
    known = [p.identifier for p in bpy.ops.drgs.reconstruct.get_rna_type().properties if not p.is_hidden]
    values = dict.fromkeys(known, "") | {"masks": masks, "poses": "auto"}
    fields = SimpleNamespace(**values, layout=Layout(shown := [], opened))
    operator.DRGS_OT_reconstruct.draw(fields, bpy.context)
    hidden = {"settings", "config", *dialog._ADVANCED, *dialog._WITHOUT_CAMERAS}
    expected = set(known) - {"rna_type", "filepath"} - (set() if opened else hidden)
    assert sorted(shown) == sorted(expected - (set() if masks == "model" else {"mask_model"}))
