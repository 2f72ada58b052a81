"""A Slurm of one node on this machine, for tests: `with slurm.one_node(folder): ...`. Needs root and slurm-wlm."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

CONF = """ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=60 State=UP
"""


def here() -> bool:
    """Return whether this machine has Slurm's programs, and may start them."""
    programs = ("munged", "slurmctld", "slurmd", "sbatch", "sinfo")
    return os.geteuid() == 0 and all(shutil.which(p, path="/usr/sbin:/usr/bin") for p in programs)


@contextlib.contextmanager
def one_node(folder: Path) -> Iterator[Path]:
    """Start munge, the controller and the node; yields the configuration's file, which SLURM_CONF names meanwhile."""
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    ports = []
    for _ in range(2):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            ports.append(probe.getsockname()[1])
    host, conf = socket.gethostname().split(".")[0], folder / "slurm.conf"
    conf.write_text(CONF.format(host=host, folder=folder, ports=ports, cpus=os.cpu_count()))
    (folder / "munge.key").write_bytes(os.urandom(1024))
    (folder / "munge.key").chmod(0o600)
    munged = ["munged", "-F", "--force", f"--socket={folder}/munge.socket", f"--key-file={folder}/munge.key",
              f"--pid-file={folder}/munge.pid", f"--log-file={folder}/munge.log", f"--seed-file={folder}/munge.seed"]
    started, before = [], os.environ.get("SLURM_CONF")
    os.environ["SLURM_CONF"] = str(conf)
    try:
        for command in (munged, ["slurmctld", "-D", "-f", conf], ["slurmd", "-D", "-f", conf]):
            with open(folder / "out.txt", "ab") as out:
                started.append(subprocess.Popen(command, stdout=out, stderr=out))
            time.sleep(1)
        limit = time.monotonic() + 60
        requested = ["sinfo", "-h", "-o", "%T"]
        while "idle" not in (said := subprocess.run(requested, capture_output=True, text=True).stdout):
            logs = "".join(p.read_text(errors="replace")[-1500:] for p in folder.glob("*.log"))
            assert time.monotonic() < limit, said + (folder / "out.txt").read_text() + logs
            time.sleep(0.5)
        yield conf
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()
        os.environ.pop("SLURM_CONF") if before is None else os.environ.update(SLURM_CONF=before)
