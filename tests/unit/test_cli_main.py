"""The command table, exit codes, output files, farm lines."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time
import tomllib

import numpy as np
import pytest
from PIL import Image

from drgs_blender.cli import doctor, sampling
from drgs_blender.cli import main as command_line
from drgs_blender.cli.find_blender import CHECKOUT, find_blender
from drgs_blender.cli.frame_lines import FrameLines
from drgs_blender.cli.main import COMMANDS, build_parser, main
from drgs_blender.cli.output import check_writable, write_preview
from drgs_blender.compute.numba_variables import check_numba_variables
from drgs_blender.core import errors
from drgs_blender.core.frame import RenderSettings
from drgs_blender.core.passes import BY_NAME


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: c.name)
def test_help_shows_examples(command, capsys):
    assert main([command.name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"examples:\n  drgs {command.name}" in text
    assert "DRGS_EXIT" not in text.splitlines()[-1]


def test_help_tells_the_default_that_counts(capsys):
    assert main(["evaluate", "--help"]) == 0
    text = capsys.readouterr().out
    said = re.search(r"default\s+(\d+)", text[text.rindex("--samples SAMPLES") :])
    given = build_parser().parse_args(["evaluate"])
    assert int(said[1]) == given.samples == 128
    assert sampling.override(RenderSettings(), given).samples == 128


@pytest.mark.parametrize("command", ["reconstruct", "evaluate"])
def test_the_conventions_of_cameras_that_can_be_chosen_are_those_that_are_known(command, capsys):
    from drgs_blender.reconstruct.readers.world_frame import AXES

    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    said = text[text.rindex("--axes") :]
    said = "".join(said[said.index("{") + 1 : said.index("}")].split())
    assert set(said.split(",")) == set(AXES)


def test_every_exit_code_has_a_class():
    codes = {value for name, value in vars(errors).items() if name.startswith("EXIT_") and name != "EXIT_CLASSES"}
    assert codes <= set(errors.EXIT_CLASSES)
    assert len(set(errors.EXIT_CLASSES.values())) == len(errors.EXIT_CLASSES)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nonsense"],
        ["relight"],
        ["relight", "a.drgs", "--camera", "c.json", "--out", "o.exr", "--samples", "0"],
        ["relight", "a.drgs", "--camera", "c.json", "--out", "o.exr", "--samples", "many"],
        ["relight", "a.drgs", "--camera", "c.json", "--out", "o.exr", "--passes", "Combined,Beauty"],
        ["relight", "a.drgs", "--camera", "c.json", "--out", "o.exr", "--env-strength", "nan"],
        ["relight", "a.drgs", "--camera", "no.json", "--out", "o.exr"],
        ["relight", "a.drgs", "--camera", "no.json", "--out", "o.jpeg"],
        ["make", "a.glb", "--out", "a.zip"],
    ],
)
def test_usage_errors_exit_64(arguments, capsys):
    assert main(arguments) == errors.EXIT_USAGE
    assert capsys.readouterr().err.strip()


@pytest.mark.parametrize(
    "option", ["--inside=1,0,0", "--inside=open", "--surface=mesh", "--surface=particles", "--passes=all"]
)
def test_options_of_relight_without_effect_are_refused_by_name(option, capsys):
    assert main(["relight", "a.drgs", "--out", "o.png", option]) == errors.EXIT_USAGE
    assert f"drgs: {option.partition('=')[0]}: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("raised", "code"),
    [
        (errors.AssetError("a.drgs", "is damaged", "Restore it"), 65),
        (errors.WriteError("o.exr", "cannot be written"), 73),
        (errors.VersionError("engine", "is older"), 78),
        (errors.EngineError("engine", "died"), 75),
        (errors.Cancelled(), 130),
        (KeyboardInterrupt(), 130),
        (SystemExit(143), 143),
        (RuntimeError("surprise"), 70),
        (MemoryError("12 GiB"), 75),
    ],
)
def test_every_end_of_a_command_has_its_exit_code(monkeypatch, capsys, raised, code):
    from drgs_blender.cli import render

    def fail(args):
        raise raised

    monkeypatch.setattr(render, "run", fail)
    assert main(["render", "s.blend", "--frames", "1", "--out", "o.exr"]) == code
    out, err = capsys.readouterr()
    assert out.splitlines()[-1] == f"DRGS_EXIT class={errors.EXIT_CLASSES[code]}"
    assert "Traceback" not in err


def test_traceback_of_an_unexpected_error_only_when_asked(monkeypatch, capsys):
    from drgs_blender.cli import doctor

    monkeypatch.setattr(doctor, "run", lambda args: 1 // 0)
    assert main(["doctor"]) == errors.EXIT_INTERNAL
    plain = capsys.readouterr().err
    assert "ZeroDivisionError" in plain and "Traceback" not in plain
    assert main(["-v", "doctor"]) == errors.EXIT_INTERNAL
    assert "Traceback" in capsys.readouterr().err


def test_warnings_are_one_line_without_control_characters(capsys, monkeypatch):
    monkeypatch.setattr(command_line.logging.getLogger(), "handlers", [])
    command_line.set_up_logging(0, False)
    command_line.logger.warning("%s: is not used", "new\nline\x1b[2J.jpg")
    assert capsys.readouterr().err == "drgs: new\\nline\\x1b[2J.jpg: is not used\n"


def test_render_refuses_before_it_starts_anything(tmp_path, capsys):
    out = str(tmp_path / "####.exr")
    scene = tmp_path / "s.blend"
    assert main(["render", str(scene), "--frames", "1-2", "--out", out]) == errors.EXIT_BAD_ASSET
    scene.touch()
    assert main(["render", str(scene), "--frames", "1-x", "--out", out]) == errors.EXIT_USAGE
    assert main(["render", str(scene), "--frames", "1-2", "--out", str(tmp_path / "a.exr")]) == errors.EXIT_USAGE
    assert main(["render", str(scene), "--frames", "1", "--out", str(scene / "a.exr")]) == errors.EXIT_CANNOT_WRITE
    absent = ["--blender", str(tmp_path / "blender")]
    assert main(["render", str(scene), "--frames", "1", "--out", out, *absent]) == errors.EXIT_USAGE
    assert [line.split("=")[1] for line in capsys.readouterr().out.splitlines()] == [
        "bad-asset", "usage", "usage", "cannot-write", "usage"
    ]  # fmt: skip


def test_reader_that_leaves_is_not_an_error_message():
    program = "import sys; from drgs_blender.cli.main import main; sys.exit(main(['doctor', '--help']))"
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    process.wait(60)
    assert b"Traceback" not in err


def test_blender_variable_that_leads_nowhere_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("DRGS_BLENDER", str(tmp_path / "gone"))
    with pytest.raises(errors.DeviceError, match="DRGS_BLENDER"):
        find_blender()


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as a program")
def test_blender_that_does_not_start_is_said(tmp_path):
    fake = tmp_path / "blender"
    fake.write_text("#!/bin/sh\necho 'libX11.so.6: cannot open shared object file' >&2\nexit 127\n")
    fake.chmod(0o755)
    with pytest.raises(errors.DeviceError, match=r"libX11\.so\.6"):
        find_blender(str(fake)).version()


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as a program")
def test_blender_may_print_what_is_no_text_here(tmp_path):
    fake = tmp_path / "blender"
    fake.write_bytes(b"#!/bin/sh\necho 'Ger\x81t'; echo 'Blender 4.2.0'\n")
    fake.chmod(0o755)
    assert find_blender(str(fake)).version() == "4.2.0"


@pytest.mark.skipif(os.name == "nt", reason="uses a shell script as a program")
@pytest.mark.parametrize("place", ["bin/python", "blender"])
def test_blender_may_be_named_by_its_folder(tmp_path, place):
    program = tmp_path / place
    program.parent.mkdir(exist_ok=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    assert find_blender(str(tmp_path)).program == program
    with pytest.raises(errors.UsageError, match="not a program"):
        find_blender(str(tmp_path / "nowhere"))


def test_values_that_begin_with_a_dash_need_no_equals_sign(tmp_path, capsys):
    scene = tmp_path / "absent.blend"
    out = str(tmp_path / "#.exr")
    assert main(["render", str(scene), "--frames", "-5--1", "--out", out]) == errors.EXIT_BAD_ASSET
    assert main(["make", "a.obj", "--up", "-q", "--out", "a.drgs"]) == errors.EXIT_USAGE


def options(arguments: list[str], defaults: bool):
    parser = command_line.Parser()
    sampling.add_arguments(parser, defaults=defaults)
    return parser.parse_args(arguments)


def test_defaults_are_those_of_the_settings():
    assert sampling.override(RenderSettings(), options([], True)) == RenderSettings()


def test_only_given_options_override_the_scene():
    scene = RenderSettings(
        samples=6, bounces=4, subpixel_samples=5, shading_model="paper", film_transparent=True, seed=9
    )
    assert sampling.override(scene, options([], False)) == scene
    changed = sampling.override(scene, options(["--samples", "64", "--no-transparent"], False))
    assert (changed.samples, changed.strategy_samples) == (64, None)
    assert (changed.film_transparent, changed.shading_model, changed.seed, changed.bounces) == (False, "paper", 9, 4)


def test_positions_that_were_not_given_are_at_most_the_rays():
    """Those of the scene, and those that the number of samples chooses."""
    scene = RenderSettings(samples=16, subpixel_samples=4)
    for words, most in ((["--samples", "1"], 1), (["--strategy-samples", "1,1,0"], 2), (["--samples", "8"], 4)):
        assert sampling.override(scene, options(words, False)).subpixel_count == most
    assert sampling.override(RenderSettings(), options(["--samples", "1"], True)).subpixel_count == 1
    with pytest.raises(errors.UsageError, match="32 is more than the 16 samples"):
        sampling.override(scene, options(["--subpixel-samples", "32"], False))


def test_without_a_command_all_are_listed(capsys):
    for words in ([], ["-q"]):
        assert main(words) == errors.EXIT_USAGE
        said = capsys.readouterr()
        assert not said.out and "COMMAND is missing" in said.err
        assert all(re.search(rf"^ +{c.name} +{c.about[:20]}", said.err, re.M) for c in COMMANDS)


def test_more_positions_than_rays_is_refused():
    with pytest.raises(errors.UsageError, match="--subpixel-samples"):
        sampling.override(RenderSettings(), options(["--samples", "4", "--subpixel-samples", "8"], True))


def test_pass_names():
    assert sampling.passes("all") == tuple(BY_NAME)
    assert sampling.passes("depth, NORMAL") == ("Combined", "Depth", "Normal")


def test_preview_is_srgb_with_straight_alpha(tmp_path):
    combined = np.zeros((1, 4, 4), np.float32)
    combined[0, 0] = (0.5, 0.5, 0.5, 1)  # IEC 61966-2-1: 0.5 -> 187.5
    combined[0, 1] = (0.25, 0, 0, 0.5)  # premultiplied red 0.5
    combined[0, 2] = (9, 9, 9, 1)
    combined[0, 3] = (np.nan, 0, 0, 0)
    write_preview(tmp_path / "p.png", combined)
    pixels = np.asarray(Image.open(tmp_path / "p.png"))
    assert pixels[0].tolist() == [[188, 188, 188, 255], [188, 0, 0, 128], [255, 255, 255, 255], [0, 0, 0, 0]]


def test_unwritable_output_is_found_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "o.exr", tmp_path):
        with pytest.raises(errors.WriteError):
            check_writable(path)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("below", ["o.exr", "a/b/o.exr"])
def test_a_file_in_the_place_of_a_folder_is_named(tmp_path, monkeypatch, capsys, below):
    """Also by the commands, those of a folder among them."""
    (tmp_path / "file").touch()
    with pytest.raises(errors.WriteError, match="is no folder") as caught:
        check_writable(tmp_path / "file" / below)
    assert caught.value.subject == str(tmp_path / "file")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.blend").touch()
    commands = {
        "make m.glb": "file/a.drgs", "render s.blend --frames 1": f"file/{below}", "capture photographs": "file/statue"
    }  # fmt: skip
    for command, out in commands.items():
        assert main([*command.split(), "--out", out]) == errors.EXIT_CANNOT_WRITE
        assert "file: is no folder. Choose another place" in capsys.readouterr().err


def test_farm_lines_parse_and_stay_benign(capsys):
    with FrameLines(interval=0) as lines:
        lines.begin(12, 16)
        lines.progress(12, "rendering", 0.63)
        lines.saved("out/0012.exr")
        lines.skipped("out/0013.exr")
    text = capsys.readouterr().out
    # What Deadline and Flamenco look for.
    assert re.findall(r"^Fra:.*Sample\s(\d+)/(\d+)$", text, re.M) == [("0", "16"), ("10", "16")]
    assert re.search(r"^Saved: '(.+)'$", text, re.M)[1] == "out/0012.exr"
    assert re.search(r"Time: \d\d:\d\d\.\d\d$", text, re.M)
    assert "skipping existing frame" in text
    assert not re.search(r"Error:|Exception:|Warning", text)


def test_heartbeat_while_nothing_is_said(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(time, "time", lambda: 1 / 0)  # the clock of a node may be set back
    with FrameLines(heartbeat=0.05) as lines:
        lines.begin(3, 16)
        deadline = time.monotonic() + 10
        while stream.getvalue().count("Fra:3") < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
    assert stream.getvalue().count("Fra:3 | Rendering | Sample 0/16") >= 3


@pytest.mark.parametrize("length", [250, 300])
def test_a_name_too_long_is_said_before_the_work(tmp_path, length):
    with pytest.raises(errors.WriteError, match="too long"):
        check_writable(tmp_path / ("n" * (length - 4) + ".exr"))
    assert not list(tmp_path.iterdir())


#: The program as pip writes it, with Ctrl+C at the moment when it begins to import a module.
BEGINS = """
import os, signal, sys
moment = sys.argv.pop(1)
def interrupt(event, about):
    global moment
    if event == "import" and about[0] == moment:
        moment = None
        os.kill(os.getpid(), signal.SIGINT)
sys.addaudithook(interrupt)
from {module} import {function}
sys.exit({function}())
"""


@pytest.mark.skipif(os.name == "nt", reason="a process cannot send Ctrl+C to itself alone")
@pytest.mark.parametrize(
    "moment",
    [
        "drgs_blender.cli.main",
        "argparse",
        "drgs_blender.core.errors",
        "drgs_blender.cli.frame_lines",
        "drgs_blender.cli.sampling",
        "drgs_blender.cli.find_blender",
    ],
)
def test_ctrl_c_while_python_imports_has_its_exit_code_and_no_traceback(moment):
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, function = project["scripts"]["drgs"].split(":")
    program = BEGINS.format(module=module, function=function)
    for name, last in (("doctor", ""), ("render", "DRGS_EXIT class=interrupted\n")):
        command = [sys.executable, "-c", program, moment, name]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=CHECKOUT)
        assert (done.returncode, done.stdout, done.stderr) == (130, last, "drgs: interrupted\n")


@pytest.mark.parametrize("minutes", ["abc", "0", "-1", "nan", "inf"])
def test_minutes_that_are_none_are_refused_in_words(minutes: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "photographs", "--out", "a.drgs", f"--time-budget={minutes}"]) == 64
    assert f"--time-budget: {minutes} is not a time above zero" in capsys.readouterr().err


RELIGHT = ["relight", "a.drgs", "--camera", "c.json", "--out", "o.exr"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([*RELIGHT, "--rays", "32"], "usage: drgs relight"),
        ([*RELIGHT, "--sample", "32"], "did you mean --samples?"),
        ([*RELIGHT, "--strategy-samples", "16,8,8", "--samples", "4"], "not allowed with argument"),
        ([*RELIGHT, "--strategy-samples", "many"], "many is not three numbers of samples, such as 16,8,8"),
        ([*RELIGHT, "--samples", "many"], "'many' is not a whole number"),
        ([*RELIGHT, "--env-strength", "much"], "'much' is not a number"),
        ([*RELIGHT, "--clamp-indirect", "1e300"], "is not a number from 0 to 3.4e+38"),
        ([*RELIGHT, "--env-strength", "1e39"], "too large"),
        (["inspect", ""], "an empty file name"),
        (["make", "", "--out", "a.drgs"], "an empty file name"),
        (["make", "a.glb", "--out", ""], "an empty file name"),
        (["render", "s.blend", "--frames", "1", "--out", ""], "an empty file name"),
        (["render", "s.blend", "--frames", "1", "--out", "o.exr", "--timeout", "soon"], "'soon' is not a number"),
        (["simulate", "a.drgs", "--out", "o", "--gravity", "down"], "'down' cannot be read"),
    ],
)
def test_what_cannot_be_parsed_is_said_in_words(words, said, capsys):
    assert main(words) == errors.EXIT_USAGE
    message = capsys.readouterr().err
    assert said in message and "invalid" not in message and "--rays-see" not in message.splitlines()[-1]


def test_an_output_replaces_no_input(tmp_path, capsys):
    source, link = tmp_path / "in.drgs", tmp_path / "link.drgs"
    source.write_bytes(b"kept")
    link.hardlink_to(source)
    (tmp_path / "1.exr").write_bytes(b"kept")
    (tmp_path / "clean").symlink_to(tmp_path, target_is_directory=True)
    own, exr = str(source), str(tmp_path / "1.exr")
    for words in (
        ["make", own, "--out", own],
        ["make", own, "--out", str(link)],
        ["make", "a.glb", "--env", own, "--out", own],
        ["import", own, "--out", own],
        ["denoise", str(tmp_path / "#.exr"), "--frames", "2,1", "--out", str(tmp_path / "clean" / "#.exr")],
        ["render", exr, "--frames", "1", "--out", exr],
    ):
        assert main(words) == errors.EXIT_USAGE, words
        assert "Choose another" in capsys.readouterr().err
    assert source.read_bytes() == b"kept" == (tmp_path / "1.exr").read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="names elsewhere are Unicode")
def test_a_name_that_openexr_cannot_open_is_said_before_the_work(tmp_path, capsys):
    out = os.fsdecode(os.fsencode(tmp_path) + b"/bad\xff.exr")
    (tmp_path / "s.blend").touch()
    assert main(["render", str(tmp_path / "s.blend"), "--frames", "1", "--out", out]) == errors.EXIT_USAGE
    assert "bad\\xff.exr: is not a name in UTF-8" in capsys.readouterr().err


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has such a file")
@pytest.mark.parametrize("size", [10, 100_000])
def test_a_full_disk_below_standard_output_is_said(monkeypatch, capsys, size):
    from drgs_blender.cli import inspect_file

    monkeypatch.setattr(inspect_file, "inspect_file", lambda path, axes, up: {"kind": "x" * size})
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["inspect", "a.drgs"]) == errors.EXIT_CANNOT_WRITE
        with pytest.raises(OSError):
            full.close()
    assert capsys.readouterr().err == "drgs: standard output cannot be written: No space left on device\n"


@pytest.mark.parametrize("setting", ["NUMBA_NUM_THREADS=0", "NUMBA_DISABLE_JIT=1"])
def test_variables_with_which_numba_is_of_no_use_are_named(monkeypatch, setting):
    name, value = setting.split("=")
    check_numba_variables()
    monkeypatch.setenv(name, value)
    with pytest.raises(errors.UsageError, match=f"{name}.*unset it"):
        check_numba_variables()
    monkeypatch.setenv(name, "many")  # Numba warns of that
    check_numba_variables()


def test_a_variable_that_fails_several_checks_is_said_at_one_of_them():
    def fail(args):
        raise errors.UsageError("DRGS_CPU_TARGET", "is foo", "Correct or unset it")

    at_card, at_kernels = (doctor.check(name, False, fail, None) for name in ("GPU", "kernels"))
    assert (at_card.state, at_card.detail) == ("none", "not checked: see kernels")
    assert (at_kernels.state, at_kernels.detail) == ("missing", "DRGS_CPU_TARGET: is foo")
