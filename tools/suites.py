"""The test suites: what is run where, and what came out.

`Plan` is what a command runs, `jobs` makes programs of it; `job_runner` runs these, `junit_report` reads what they
wrote. Standard library only.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from job_runner import SECONDS, Job, Runner
from junit_report import Report

#: The slow faults, of which `DRGS_FAULTS=whole` runs all, take as many times as long.
WHOLE_TIMES = 15
#: Python says where a test is that takes longer than any: so a suite that is ended names it.
STUCK_SECONDS = 600
#: An artist's work at an artist's pace takes as many times as long.
WINDOW_TIMES = 3
#: With one processor, too, two suites run side by side: many tests wait for other programs.
LEAST_WORKERS, MOST_WORKERS = 2, 8
SLOWEST = 25
#: Exit code of pytest for options or files that it cannot use.
USAGE = 4
LINT = "lint"
WINDOW = "window"


class Failure(Exception):
    """A step that cannot go on; the message is for the user."""


@dataclass(frozen=True)
class Suite:
    """Tests that run in one environment.

    Attributes
    ----------
    title : str
        For people.
    folders : tuple of str
        Of tests, from the root of the checkout.
    spread : bool
        Whether its files are spread over processes (Blender takes too long to start for that).
    times : int
        How many times longer than others it may take.
    leaves : str
        Marks of tests that it leaves to others, as an expression of pytest, unless it is asked for by name.
    """

    title: str
    folders: tuple[str, ...]
    spread: bool = False
    times: int = 1
    leaves: str = ""


@dataclass
class Plan:
    """The plan of one command: suites, files, options.

    Attributes
    ----------
    part : str
        ``fast``, ``slow`` (all that ``fast`` leaves out) or ``all``.
    suites : list of str
        Names, in order.
    whole_suites : list of str
        Those of which all is run whatever `part` says.
    named : bool
        Whether the suites were asked for by name.
    files : list of str
        Files, folders and single tests asked for; empty for all.
    options : list of str
        Further arguments of pytest.
    """

    part: str
    suites: list[str]
    whole_suites: list[str] = field(default_factory=list)
    named: bool = False
    files: list[str] = field(default_factory=list)
    options: list[str] = field(default_factory=list)

    @property
    def selects(self) -> bool:
        """Whether some tests were asked for, so that a suite may have none of them."""
        return bool(self.files or self.options)

    @property
    def name(self) -> str:
        """Folder of the reports: those of a choice of tests do not replace those of all."""
        return "chosen" if self.selects or self.named else self.part


def parse(words: Sequence[str], names: Iterable[str], root: Path) -> tuple[list[str], list[str], list[str]]:
    """Tell the words of ``ARGS`` apart.

    Suites, files, folders and tests (``tests/unit/test_light.py::test_it``) come first, and what follows from the
    first option on is pytest's: ``-k farm`` is a word to look for, no suite.

    Parameters
    ----------
    words : sequence of str
        As given.
    names : iterable of str
        The suites there are.
    root : Path
        The checkout.

    Returns
    -------
    suites, files, options : list of str

    Raises
    ------
    Failure
        For a word that is neither, or an option without its word.
    """
    known, suites, files = list(names), [], []
    first = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    for word in words[:first]:
        if word in known:
            suites.append(word)
        elif (root / word.split("::")[0]).exists():
            files.append(Path(word).as_posix())
        else:
            raise Failure(
                f"{word} is neither a suite nor a file; there are the suites {', '.join(known)}, and -k {word} runs "
                "the tests with that word in their name"
            )
    if words and words[-1] in ("-k", "-m"):  # pytest would take the folder that follows for it
        raise Failure(f"{words[-1]} needs a word after it, as in {words[-1]} material")
    for word in words[first:]:
        if ("/" in word or word.endswith(".py")) and not word.startswith("-") and (root / word.split("::")[0]).exists():
            raise Failure(f"name {word} before the options, which pytest is given as they are")
    return suites, files, list(words[first:])


def within_suite(file: str, suite: Suite) -> list[str]:
    """What of a file, a folder or a test is a suite's: itself, those folders of the suite that it holds, or nothing."""
    path = file.split("::")[0].rstrip("/")
    if any(f"{path}/".startswith(f"{folder}/") for folder in suite.folders):
        return [file]
    return [folder for folder in suite.folders if folder.startswith(f"{path}/")]


# Jobs


KERNELS = "kernels"


def lint(python: Path, root: Path, folder: Path) -> Job:
    """Formats, rules, spelling and types.

    The extension is named as its folder: only from within a package does ``..drgs_blender`` lead anywhere. A dot would
    divide that name, so in such a folder the extension's types go unchecked.
    """
    tools = [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["codespell_lib"], ["mypy"]]
    if "." not in root.name:
        tools.append(["mypy", "-p", f"{root.name}.addon", "-p", f"{root.name}.operators", "-m", root.name])
    return Job(LINT, [[str(python), "-m", *tool] for tool in tools], folder / "lint.log")


def prepare_kernels(python: Path, root: Path, folder: Path) -> Job | None:
    """Compile all kernels that are not in the cache, in parallel, before the tests would one by one.

    None where this checkout has no such program.
    """
    if not (root / "drgs_blender" / "compute" / "prepare.py").exists():
        return None
    command = [str(python), "-m", "drgs_blender.compute.prepare", "--all"]
    return Job(KERNELS, [command], folder / "kernels.log")


def workers() -> int:
    """Suites and processes at a time: one for each processor."""
    return min(max(os.cpu_count() or 1, LEAST_WORKERS), MOST_WORKERS)


def suite_jobs(name: str, suite: Suite, plan: Plan, python: Path, root: Path, folder: Path, after: str) -> list[Job]:
    """One suite's jobs: the tests that run beside others and those that need the machine for themselves.

    A choice of tests is one job, as it is to be quick, with all threads.
    """
    files = [each for file in plan.files for each in within_suite(file, suite)] or list(suite.folders)
    part = "all" if name in plan.whole_suites or any("::" in file for file in files) else plan.part
    whole = WHOLE_TIMES if os.environ.get("DRGS_FAULTS") == "whole" else 1
    made = []
    for lane in ("all",) if plan.selects else ("shared", "alone"):
        among = files_marked_alone(files, root) if lane == "alone" else files
        if not among:
            continue
        own = f"{name}-alone" if lane == "alone" else name
        report = folder / f"{own}.xml"
        command = [str(python), "-m", "pytest", "-q", f"--part={part}", f"--lane={lane}", f"--junitxml={report}"]
        command += ["-o", f"cache_dir=.pytest_cache/{own}", "-o", f"faulthandler_timeout={STUCK_SECONDS}"]
        if suite.leaves and not plan.named and not any("::" in file for file in files):
            command += ["-m", f"not ({suite.leaves})"]
        environment = {}
        if lane == "shared" and suite.spread:
            command += ["-n", str(workers()), "--dist", "loadfile"]
            if part == "fast":
                # arrays of these tests are small: threads would wait for each other, and for the other processes
                environment = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        title = f"{suite.title}, alone" if lane == "alone" else suite.title
        commands, log, seconds = (
            [[*command, *plan.options, *among]],
            folder / f"{own}.log",
            suite.times * SECONDS * whole,
        )
        job = Job(title, commands, log, report, seconds, environment, after)
        job.alone = lane == "alone" or name == WINDOW
        job.may_be_empty = lane == "alone" or plan.selects
        made.append(job)
    return made


def files_marked_alone(files: Iterable[str], root: Path) -> list[str]:
    """Files (also in the folders) that hold tests marked ``alone``: others need not be imported."""
    found = []
    for file in files:
        path = root / file.split("::")[0]
        if path.is_dir():
            modules = sorted(path.rglob("test_*.py"))
            found += [m.relative_to(root).as_posix() for m in modules if "mark.alone" in m.read_text(encoding="utf-8")]
        elif "mark.alone" in path.read_text(encoding="utf-8"):
            found.append(file)
    return found


def jobs(
    plan: Plan, suites: Mapping[str, Suite], python_of: Mapping[str, Callable[[], Path]], root: Path, folder: Path
) -> list[Job]:
    """Jobs of a plan; makes the environments that it needs.

    Parameters
    ----------
    plan : Plan
        What to run.
    suites : mapping of str to Suite
        By name.
    python_of : mapping of str to function
        Makes the environment of a suite and gives its interpreter.
    root, folder : Path
        The checkout; where reports go.

    Returns
    -------
    list of Job
    """
    made: list[Job] = []
    if LINT in plan.suites:
        made.append(lint(python_of[LINT](), root, folder))
    after = ""
    if not plan.selects and (kernels := prepare_kernels(python_of[LINT](), root, folder)):
        made.append(kernels)
        after = kernels.title
    named = [name for name in plan.suites if name != LINT]
    if plan.files:
        named = [name for name in named if any(within_suite(file, suites[name]) for file in plan.files)]
    for name in named:
        made += suite_jobs(name, suites[name], plan, python_of[name](), root, folder, after)
    return sorted(made, key=lambda job: job.alone)


# Running


def run(
    plan: Plan, suites: Mapping[str, Suite], python_of: Mapping[str, Callable[[], Path]], root: Path,
    environment: Mapping[str, str],
) -> int:  # fmt: skip
    """Run a plan and say what came out; 0 when everything passed.

    Reports and what suites printed go to ``build/tests``, times to ``build/durations.json``.
    """
    build = root / "build"
    folder = build / "tests" / plan.name
    earlier = build / "tests" / "fast"
    if plan.name == "slow" and not earlier.is_dir():
        raise Failure("--rest is what the fast tests leave: run these first")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    all_jobs = jobs(plan, suites, python_of, root, folder)
    if not all_jobs:
        raise Failure(f"none of the suites {', '.join(plan.suites)} holds {', '.join(plan.files)}")
    runner = Runner(root, bytecode_folder(environment, build), workers())
    began = time.monotonic()
    runner.run(all_jobs)
    report, wrong, left = Report(), [], 0
    if refused := [job.log for job in all_jobs if job.report is not None and USAGE in runner.codes[job.title]]:
        raise Failure(f"pytest does not run {' '.join([*plan.files, *plan.options])}: {usage_error(refused[0])}")
    for job in all_jobs:
        codes, tests = runner.codes[job.title], 0
        if job.report is not None:
            tests = report.add(job.report)
            left += left_out(job.report)
            if not tests and not job.may_be_empty:
                wrong.append(job.title)
        wrong += [job.title] * (any(codes) and job.title not in wrong)
    return summarise(plan, report, wrong, left, time.monotonic() - began, earlier, build)


def usage_error(log: Path) -> str:
    """The error that pytest printed last before it ended with `USAGE`."""
    text = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""  # a job alone has no log
    found = re.findall(r"error: (.+)", text, re.IGNORECASE)
    return found[-1].strip() if found else "its message is above"


def summarise(
    plan: Plan, report: Report, wrong: list[str], left: int, seconds: float, earlier: Path, build: Path
) -> int:
    """Print what came out; the exit code."""
    if plan.name == "slow":
        for path in sorted(earlier.glob("*.xml")):
            report.add(path)
    elif plan.selects and any(name != LINT for name in plan.suites) and not report.durations and not wrong:
        asked = " ".join([*plan.files, *plan.options])
        wrong.append(f"only slow tests fit {asked}, which `make check` runs" if left else f"no test fits {asked}")
    elif plan.selects and left:
        print(f"{left} slow tests that fit as well were left to `make check`")
    if plan.name != "chosen":
        report.write(build / "durations.json")
        if plan.part != "fast":
            print(f"the {SLOWEST} slowest tests (all are in build/durations.json):")
            print("\n".join(report.slowest(SLOWEST)))
    if wrong:
        print(f"not passed: {', '.join(wrong)}")
    print(f"took {seconds:.0f} s")
    print(f"{report.passed} passed, {report.failed} failed, {report.skipped} skipped", flush=True)
    return 1 if wrong or report.failed else 0


def left_out(report: Path) -> int:
    """Number of matching slow tests that were left out, which tests/pace.py writes beside the report."""
    with contextlib.suppress(OSError, ValueError):
        return int(report.with_suffix(".left").read_text(encoding="utf-8"))
    return 0


def bytecode_folder(environment: Mapping[str, str], build: Path) -> dict[str, str]:
    """Variables with which compiled tests are kept in ``build``, also where PYTHONDONTWRITEBYTECODE is set.

    To rewrite the assertions of all tests takes longer than to run many of them.
    """
    kept = {name: value for name, value in environment.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {"PYTHONPYCACHEPREFIX": str(build / "pycache")} | kept
