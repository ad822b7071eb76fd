"""The folder of compiled kernels: what is removed from it, who may read and write it, where it is without a home."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drgs_blender.compute import folders

ROOT = Path(__file__).resolve().parents[2]
OLD = time.time() - 60 * 24 * 3600
KERNEL = f"f-{'0' * 24}.kernel"
#: A user whom no system knows.
NOBODY = 54321
posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="users are told apart, and processes fork, on POSIX")

#: A kernel that says whether it was compiled, or else found.
DOUBLE = """
from drgs_blender.compute.jit import njit
@njit
def double(x):
    return 2 * x
print(double(21), "found" if double.stats.cache_hits else "compiled")
"""


def run(program: str, user: int | None = None, **variables: str | None) -> str:
    """What a program in a process of its own prints, errors as well; of variables, None is one that is not set."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | variables
    options: dict[str, Any] = {} if user is None else {"user": user, "group": user, "extra_groups": []}
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        env={name: value for name, value in environment.items() if value is not None},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd="/",
        **options,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture
def of_nobody() -> Iterator[Path]:
    """A folder that a user without a name may write, and nobody else."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root may become another user")
    folder = Path(tempfile.mkdtemp())
    os.chown(folder, NOBODY, NOBODY)
    try:
        run("import drgs_blender", NOBODY)
    except (AssertionError, OSError):
        pytest.skip("other users may not read this checkout")
    else:
        yield folder
    finally:
        shutil.rmtree(folder)


@pytest.fixture(scope="module")
def double() -> Iterator[Callable[..., str]]:
    """Runs `DOUBLE`, whose source is a file that all may read, with a folder of kernels."""
    place = Path(tempfile.mkdtemp())
    place.chmod(0o755)
    (place / "double.py").write_text(DOUBLE)

    def started(folder: Path, user: int | None = None, before: str = "", **variables: str | None) -> str:
        program = f"{before}\nimport runpy\nrunpy.run_path({str(place / 'double.py')!r})"
        return run(program, user, **({"DRGS_CACHE_DIR": str(folder), "DRGS_SHIPPED": "0"} | variables))

    yield started
    shutil.rmtree(place)


@pytest.fixture(scope="module")
def compiled(double: Callable[..., str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the kernel of `double`, to be copied."""
    folder = tmp_path_factory.mktemp("compiled") / "kernels"
    assert double(folder) == "42 compiled\n"
    return folder


def age(path: Path) -> None:
    for each in (*path.rglob("*"), path):
        os.utime(each, (OLD, OLD), follow_symlinks=False)


def test_only_what_is_ours_is_ever_removed(tmp_path: Path) -> None:
    """The variable may name any folder of the user's."""
    ours, theirs = tmp_path / f"geometry-{'a' * 16}", tmp_path / f"mine-{'b' * 16}"
    for folder, name in (
        (ours, KERNEL),
        (theirs, KERNEL),
        (theirs, "letter.txt"),
        (tmp_path / "photos", "a.jpg"),
    ):
        folder.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"x")
    (tmp_path / f"sources-{'c' * 16}.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "loop").symlink_to("loop")
    age(tmp_path)
    folders._prune(tmp_path)
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")}
    assert left == {f"mine-{'b' * 16}", f"mine-{'b' * 16}/letter.txt", "photos", "photos/a.jpg", "notes.txt", "loop"}


def test_what_a_killed_process_was_writing_is_removed_from_a_folder_in_use(tmp_path: Path) -> None:
    folder = tmp_path / f"geometry-{'a' * 16}"
    folder.mkdir()
    for name in (f".f.kernel.{'0' * 12}.tmp", f".g.kernel.{'1' * 12}.tmp", "h-0.kernel"):
        (folder / name).write_bytes(b"x")
    os.utime(folder / f".f.kernel.{'0' * 12}.tmp", (OLD, OLD))
    folders._prune(tmp_path)
    assert {path.name for path in folder.iterdir()} == {f".g.kernel.{'1' * 12}.tmp", "h-0.kernel"}


@pytest.mark.parametrize("named", ["", "relative/folder"])
def test_a_cache_folder_that_is_none_is_as_if_unset(monkeypatch: pytest.MonkeyPatch, named: str) -> None:
    monkeypatch.delenv("DRGS_CACHE_DIR", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    assert folders.wanted_folder() == Path.home() / ".cache/drgs/kernels"


def test_a_folder_that_is_named_relatively_stays_where_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DRGS_CACHE_DIR", "kernels")
    assert folders.wanted_folder() == tmp_path / "kernels"
    monkeypatch.setenv("DRGS_CACHE_DIR", "~/kernels")
    assert folders.wanted_folder() == Path.home() / "kernels"


def test_what_others_put_into_a_folder_of_kernels_stays(tmp_path: Path) -> None:
    kernels = tmp_path / f"geometry-{'a' * 16}"
    (kernels / "photos").mkdir(parents=True)
    for name in (KERNEL, f".{KERNEL}.lock.tmp", f".{KERNEL}.{'a' * 12}.tmp", "my.kernel", ".my.tmp", "photos/a.jpg"):
        (kernels / name).write_bytes(b"x")
    age(tmp_path)
    for _ in range(2):
        folders._prune(tmp_path)
    left = {path.relative_to(kernels).as_posix() for path in kernels.rglob("*")}
    assert left == {"my.kernel", ".my.tmp", "photos", "photos/a.jpg"}


@pytest.mark.parametrize("now", [60.0, time.time()], ids=["1970", "now"])
def test_what_is_of_the_future_is_not_old(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, now: float) -> None:
    """A clock may have been ahead when it was made, or be behind now; then nothing is old."""
    ahead, old = tmp_path / f"ahead-{'a' * 16}", tmp_path / f"old-{'b' * 16}"
    for folder, stamp in ((ahead, time.time() + 2e9), (old, OLD)):
        folder.mkdir()
        (folder / KERNEL).write_bytes(b"x")
        os.utime(folder, (stamp, stamp))
    monkeypatch.setattr(time, "time", lambda: now)
    folders._prune(tmp_path)
    assert (ahead / KERNEL).exists() and old.exists() == (now == 60.0)


def test_kernels_of_a_sealed_disk_are_used(
    double: Callable[..., str], compiled: Path, small_disk: Callable[[str], Path], tmp_path: Path
) -> None:
    """As those in a container's image are; that no more can be kept is said once."""
    disk, scratch = small_disk("size=4m"), tmp_path / "scratch"
    kernels = disk / "kernels"
    scratch.mkdir()
    shutil.copytree(compiled, kernels)
    small_disk("ro")
    said = double(kernels, TMPDIR=str(scratch))
    assert "42 found" in said and len(said.splitlines()) == 2 and f"{kernels} (Read-only file system)" in said
    assert not list(scratch.iterdir())


def test_kernels_in_a_folder_without_the_right_to_write_are_used(
    double: Callable[..., str], compiled: Path, of_nobody: Path
) -> None:
    kernels = shutil.copytree(compiled, of_nobody / "kernels")
    for path in (*kernels.rglob("*"), kernels):
        os.chown(path, NOBODY, NOBODY)
        path.chmod(0o500 if path.is_dir() else 0o400)
    said = double(kernels, NOBODY)
    assert "42 found" in said and f"{kernels} (Permission denied)" in said


@posix
@pytest.mark.parametrize("owner", ["own", "another"])
def test_kernels_that_another_user_puts_in_place_of_ours_are_not_used(
    double: Callable[..., str], compiled: Path, tmp_path: Path, owner: str
) -> None:
    """The folder is looked at when a process starts; whoever may turn a link on the way to it can do so later."""
    if os.geteuid() != 0:
        pytest.skip("only root may give files away")
    ours, theirs, link = tmp_path / "ours", tmp_path / "theirs", tmp_path / "link"
    for copy in (ours, theirs):
        shutil.copytree(compiled, copy)
    for path in theirs.rglob("*.kernel" if owner == "another" else "nothing"):
        os.chown(path, NOBODY, NOBODY)
    link.symlink_to(ours)
    turn = f"""
import os
from drgs_blender.compute.folders import cache_folder
assert not cache_folder().trouble
os.unlink({str(link)!r})
os.symlink({str(theirs)!r}, {str(link)!r})
"""
    assert double(link, before=turn) == ("42 found\n" if owner == "own" else "42 compiled\n")


@posix
def test_a_folder_into_which_others_may_write_comes_with_what_to_do(tmp_path: Path) -> None:
    mine = tmp_path / "it's mine"
    mine.mkdir()
    mine.chmod(0o777)
    said = folders._unsafe(mine)
    order = said.partition("run ")[2].partition(", or")[0]
    subprocess.run(["sh", "-c", order], check=True)
    assert "DRGS_CACHE_DIR" in said and folders._unsafe(mine) == ""


def test_without_a_home_the_engine_works_and_says_so(double: Callable[..., str], of_nobody: Path) -> None:
    said = double(Path(), NOBODY, DRGS_CACHE_DIR=None, HOME=None, XDG_CACHE_HOME=None, TMPDIR=str(of_nobody))
    assert "42 compiled" in said and "there is no home folder: name a folder in DRGS_CACHE_DIR" in said
    assert not list(of_nobody.iterdir())


#: Makes a temporary folder, since its own is none, and prints it.
MAKE = "import os, sys\nfrom drgs_blender.compute import folders\nprint(folders.cache_folder().path, flush=True)\n"


@pytest.fixture
def make(tmp_path: Path) -> Callable[[str], Path]:
    """Runs `MAKE` and more; the folder."""
    (tmp_path / "file").touch()

    def made(ending: str) -> Path:
        said = run(MAKE + ending, DRGS_CACHE_DIR=str(tmp_path / "file"), TMPDIR=str(tmp_path))
        return Path(said.splitlines()[-1])

    return made


def sweep(place: Path) -> None:
    run("from drgs_blender.compute import folders\nfolders._sweep()", TMPDIR=str(place))


@pytest.mark.parametrize("ending", ["", "folders.leave_temporary(); os._exit(0)"])
def test_temporary_folders_end_with_their_processes(make: Callable[[str], Path], ending: str) -> None:
    assert not make(ending).exists()


@posix
def test_the_temporary_folder_of_a_killed_process_is_removed_by_the_next(make: Callable[[str], Path]) -> None:
    folder = make("os._exit(0)")
    assert folder.exists()
    sweep(folder.parent)
    assert not folder.exists()


@posix
def test_a_fork_leaves_the_temporary_folder_and_its_lock_to_the_process_that_made_it(
    make: Callable[[str], Path],
) -> None:
    looks = "assert folders.cache_folder().path.exists(); os._exit(0)"
    sweeps = "subprocess.run([sys.executable, '-c', 'from drgs_blender.compute import folders; folders._sweep()'])"
    folder = make(f"""
import subprocess
if os.fork() == 0:
    folders.leave_temporary()
    sys.exit(0)
assert os.wait()[1] == 0
{sweeps}
{looks}
""")
    sweep(folder.parent)
    assert not folder.exists()


@posix
@pytest.mark.parametrize("name", ["drgs-kernels-2026", "drgs-kernels-99999999-mine"])
@pytest.mark.parametrize("has_mark", [False, True])
def test_a_folder_of_the_users_is_not_taken_for_a_temporary_one(tmp_path: Path, name: str, has_mark: bool) -> None:
    """Not by its name, nor by a file that somebody put into it."""
    mine = tmp_path / name
    mine.mkdir(mode=0o700)
    (mine / "letter.txt").touch()
    if has_mark:
        (mine / folders._ALIVE).touch(0o666)
        (mine / folders._ALIVE).chmod(0o666)
    program = "import os\nfrom drgs_blender.compute import folders\nassert not folders.cache_folder().trouble\n"
    run(program + "folders.leave_temporary()\nos._exit(0)", DRGS_CACHE_DIR=str(mine), TMPDIR=str(tmp_path))
    sweep(tmp_path)
    assert (mine / "letter.txt").exists()


@posix
def test_the_temporary_folder_of_another_container_stays_while_its_process_lives(tmp_path: Path) -> None:
    """Its number says nothing: there it is one that no process has here."""
    free = next(number for number in range(30000, 300, -1) if not Path(f"/proc/{number}").exists())
    program = f"""
import os
with open("/proc/sys/kernel/ns_last_pid", "w") as file:
    file.write("{free - 1}")
if os.fork() == 0:
    assert os.getpid() == {free}
    from drgs_blender.compute import folders
    print(folders.cache_folder().path, flush=True)
    input()
    os._exit(0)
os.wait()
"""
    (tmp_path / "file").touch()
    variables = {"PYTHONPATH": str(ROOT), "DRGS_CACHE_DIR": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    command = ["unshare", "--pid", "--fork", sys.executable, "-P", "-c", program]
    if shutil.which("unshare") is None or subprocess.run([*command[:3], "true"], capture_output=True).returncode:
        pytest.skip("no container can be made here")
    container = subprocess.Popen(
        command, env=os.environ | variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with container:
        assert container.stdout is not None and container.stdin is not None
        folder = Path(container.stdout.readline().strip())
        assert folder.parent == tmp_path and folder.is_dir()
        sweep(tmp_path)
        assert folder.is_dir()
        container.stdin.write("\n")
    sweep(tmp_path)
    assert not folder.exists()


def test_what_is_written_is_seen_whole_or_not_at_all(tmp_path: Path) -> None:
    path, size = tmp_path / "file", 1 << 22
    folders.write_atomically(path, b"0" * size)
    program = f"""
import sys
print("ready", flush=True)
while True:
    with open({str(path)!r}, "rb") as file:
        data = file.read()
    if len(data) != {size} or len(set(data[:: 1 << 12])) != 1:
        sys.exit(f"{{len(data)}} bytes of {{set(data)}}")
"""
    reader = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert reader.stdout is not None and reader.stdout.readline() == "ready\n"
        for turn in range(60):
            folders.write_atomically(path, b"%d" % (turn % 10) * size)
        assert reader.poll() is None, reader.stderr and reader.stderr.read()
    finally:
        reader.kill()
        reader.communicate()
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_leaves_what_was_there(small_disk: Callable[[str], Path]) -> None:
    disk = small_disk("size=64k")
    folders.write_atomically(disk / "file", b"before")
    with pytest.raises(OSError, match="space"):
        folders.write_atomically(disk / "file", bytes(1 << 17))
    assert [path.name for path in disk.iterdir()] == ["file"] and (disk / "file").read_bytes() == b"before"
