"""Slurm on one machine: a controller and three nodes of one core each, as root, without systemd."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import psutil
from processes import marked

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")
NODES = ("n1", "n2", "n3")
_CONF = """\
ClusterName=drgs
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={root}/munge.sock,cred_expire=5
StateSaveLocation={root}/state
SlurmdSpoolDir={root}/spool/%n
SlurmctldPidFile={root}/ctld.pid
SlurmdPidFile={root}/%n.pid
SlurmctldLogFile={root}/ctld.log
SlurmdLogFile={root}/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdTimeout=10
JobRequeue=1
KillWait=2
ReturnToService=2
MpiDefault=none
SwitchType=switch/none
SchedulerParameters=sched_interval=1,bf_interval=1
SlurmdParameters=config_overrides
PartitionName=farm Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
#: Sessions of OpenJD as tasks of an array, each with a part of the frames (docs/farm/openjd.md).
_SESSIONS = """\
#!/bin/bash
#SBATCH --array=0-{last}
#SBATCH --output={job}/logs/%x-%a.log
frames=({parts})
echo "drgs: node $SLURMD_NODENAME"
exec {command} --step "$1" -p Frames="${{frames[SLURM_ARRAY_TASK_ID]}}"
"""


def absent() -> str:
    """What is lacking for it, "" when nothing is."""
    lacking = [name for name in PROGRAMS if not shutil.which(name)]
    return f"{', '.join(lacking)} not installed" if lacking else "" if os.geteuid() == 0 else "slurmd needs root"


class Trio:
    """A running cluster; a context manager, at whose end it is gone."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.env = os.environ | {"SLURM_CONF": str(root / "slurm.conf")}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Trio:
        try:
            self._start_all()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _start_all(self) -> None:
        (self.root / "state").mkdir()
        (self.root / "spool").mkdir()
        key = self.root / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        files = [f"--{kind}-file={self.root}/munge.{kind}" for kind in ("key", "pid", "log", "seed")]
        self._start("munged", "munged", "--foreground", "--force", *files, f"--socket={self.root}/munge.sock")
        self.until(lambda: (self.root / "munge.sock").exists(), 10)
        port, *ports = free_ports(1 + len(NODES))
        host = socket.gethostname().split(".")[0]
        text = _CONF.format(root=self.root, host=host, port=port)
        for name, own in zip(NODES, ports, strict=True):
            text += f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={own} CPUs=1 State=UNKNOWN\n"
        (self.root / "slurm.conf").write_text(text)
        self._start("slurmctld", "slurmctld", "-D", "-c")
        for name in NODES:
            self._start(name, "slurmd", "-D", "-N", name)
        self.until(lambda: self.ask("sinfo", "-h", "-o", "%D %T") == "3 idle", 30)

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes.values()):
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for pid in self._of_this_cluster():  # what runs jobs outlives its node
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, 9)

    def ask(self, *command: str) -> str:
        """What a command of Slurm prints."""
        return subprocess.run(command, env=self.env, capture_output=True, text=True, timeout=60).stdout.strip()

    def submit_sessions(self, job: Path, openjd: Path, command: str, parts: Sequence[str]) -> None:
        """Submit the array that renders and the one that denoises after it, of sessions of a bundle of OpenJD.

        Parameters
        ----------
        job : folder of the bundle, with room for `logs`: render-0.log, ..., denoise-0.log, ...
        openjd : the program
        command : what `drgs submit openjd` printed, which would run the bundle in one session
        parts : the frames of each session
        """
        words = shlex.split(command)
        parameters = words[words.index("-p") :]
        script = job / "sessions.sbatch"
        (job / "logs").mkdir()
        command = shlex.join([str(openjd), "run", str(job / "template.json"), *parameters])
        script.write_text(_SESSIONS.format(last=len(parts) - 1, job=job, parts=" ".join(parts), command=command))
        after: list[str] = []
        for step in ("Render", "Denoise"):
            number = self.ask("sbatch", "--parsable", f"--job-name={step.lower()}", *after, str(script), step)
            after = [f"--dependency=afterok:{number}", "--kill-on-invalid-dep=yes"]

    def until(self, condition, seconds: float) -> None:
        """Wait until `condition` holds; fails when it does not in time."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"not within {seconds} s; queue: {self.ask('squeue')}; {self.ask('sinfo')}")
            time.sleep(0.2)

    def until_done(self, seconds: float) -> None:
        """Wait until no job waits or runs."""
        self.until(lambda: not self.ask("squeue", "-h"), seconds)

    def kill_node(self, name: str) -> None:
        """End a node with all it runs, as a power cut does."""
        self._processes[name].kill()
        run = self._of_this_cluster(f"SLURMD_NODENAME={name}")
        # First who would tell the controller that the job has ended: the parents of its scripts.
        parents = set()
        for pid in run:
            with contextlib.suppress(psutil.NoSuchProcess):
                parents.add(psutil.Process(pid).ppid())
        steps = parents & set(self._of_this_cluster())
        for pid in [*(steps - set(run)), *run]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, 9)

    def _of_this_cluster(self, *marks: str) -> list[int]:
        """Processes with the cluster, and `marks`, in their environment; not this one."""
        return marked(f"SLURM_CONF={self.root}/slurm.conf", *marks)

    def _start(self, name: str, *command: str) -> None:
        with open(self.root / f"{name}.out", "wb") as out:
            self._processes[name] = subprocess.Popen(command, env=self.env, stdout=out, stderr=out)


def free_ports(count: int) -> list[int]:
    """Ports of this machine that nobody uses."""
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports
