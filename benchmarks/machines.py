"""One training over several machines, tried on one: nodes that are network namespaces, joined by virtual cables.

    python -m benchmarks.machines [gpus=4] [nodes=2] [gbit=,10] [iterations=20] [seconds=150] [out=out/machines]
                                  [key=value of dexsim train ...]

Each node has folders, an address and, for NCCL, a host of its own: between nodes there are sockets only, within one
what the machine has (NVLink). Compared are all ranks on one node with the same ranks on `nodes` nodes, for each rate of
the cable in `gbit` (empty: as fast as the kernel copies). The traffic is what the kernel counted at the cables, between
iterations. From it follows what cables of 10 and 100 Gbit/s give: the seconds of an iteration on one node, or on nodes
with a free cable, and those that the bytes need at that rate while nothing else goes on.
device=cpu: gloo. Needs root and iproute2; where there are no namespaces, all nodes share the loopback address.
"""

from __future__ import annotations

import csv
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.options import options
from dexsim.console.ending import guard
from dexsim.errors import UserError

DEFAULTS = {"gpus": 4, "nodes": 2, "gbit": ",10", "iterations": 20, "seconds": 150, "out": "out/machines"}
PORT = 29471
FIRST = 5
"""Iterations that are left out of rates: kernels and graphs are made."""
CABLES = (10.0, 100.0)
"""Gbit/s for which is computed what they give."""


_COUNT = itertools.count()


def sh(*command: str, check: bool = True) -> subprocess.CompletedProcess:
    """Run a command of the network's."""
    return subprocess.run(command, capture_output=True, text=True, check=check)


class Nodes:
    """Several network namespaces on one bridge: dexsim<k> with the address 10.77.0.<k + 1>. A context manager.

    gbit: rate of each node's cable in Gbit/s, both ways; None: unlimited.
    """

    def __init__(self, count: int, folder: Path, gbit: float | None = None, env: dict[str, str] | None = None) -> None:
        self.count, self.gbit, self.folder, self.env = count, gbit, folder, env or {}
        tag = f"{os.getpid() % 10000}c{next(_COUNT)}"  # the kernel takes its time to forget those of before
        self.names = [f"dexsim{tag}n{k}" for k in range(count)]
        self.addresses = [f"10.77.0.{k + 1}" for k in range(count)]
        self.bridge = f"dxb{tag}"
        self.separate = True
        """Whether the nodes are namespaces; else all are 127.0.0.1."""

    def __enter__(self) -> Nodes:
        for k in range(self.count):
            (self.folder / f"node{k}").mkdir(parents=True, exist_ok=True)
        try:
            self._build()
        except (OSError, subprocess.CalledProcessError) as error:
            self._destroy()
            self.separate, self.addresses = False, ["127.0.0.1"] * self.count
            why = getattr(error, "stderr", None) or error
            print(f"  no network namespaces here ({str(why).strip()}): all nodes are at 127.0.0.1", flush=True)
        return self

    def __exit__(self, *_: object) -> None:
        self._destroy()

    def _build(self) -> None:
        sh("ip", "link", "add", self.bridge, "type", "bridge")
        sh("ip", "link", "set", self.bridge, "up")
        for k, name in enumerate(self.names):
            outer = f"{self.bridge}p{k}"
            etc = Path("/etc/netns", name)  # its /etc: who is who, and nobody to ask for other names
            etc.mkdir(parents=True)
            (etc / "resolv.conf").write_text("nameserver 127.0.0.1\noptions timeout:1 attempts:1\n")
            hosts = [f"{a} node{n}" for n, a in enumerate(self.addresses)]
            (etc / "hosts").write_text("\n".join(["127.0.0.1 localhost", *hosts, ""]))
            sh("ip", "netns", "add", name)
            sh("ip", "link", "add", outer, "type", "veth", "peer", "name", "eth0", "netns", name)
            sh("ip", "link", "set", outer, "master", self.bridge, "up")
            sh("ip", "-n", name, "addr", "add", f"{self.addresses[k]}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                sh("ip", "-n", name, "link", "set", device, "up")
            if self.gbit is not None:
                shape = ["root", "tbf", "rate", f"{self.gbit:g}gbit", "burst", "16mb", "latency", "50ms"]
                sh("ip", "netns", "exec", name, "tc", "qdisc", "add", "dev", "eth0", *shape)

    def _destroy(self) -> None:
        for name in self.names:
            sh("ip", "netns", "del", name, check=False)
            shutil.rmtree(Path("/etc/netns", name), ignore_errors=True)
        sh("ip", "link", "del", self.bridge, check=False)

    def cut(self, node: int) -> None:
        """Pull the cable of a node."""
        sh("ip", "link", "set", f"{self.bridge}p{node}", "down")

    def sent(self) -> list[int]:
        """Return bytes that each node has sent to others so far; of nodes that are not apart, an equal share of what
        the loopback carried."""
        out = []
        for name in self.names:
            where = ("ip", "netns", "exec", name) if self.separate else ()
            device = "eth0" if self.separate else "lo"
            text = sh(*where, "cat", "/proc/net/dev").stdout
            line = next(x for x in text.splitlines() if x.strip().startswith(f"{device}:"))
            out.append(int(line.split(":")[1].split()[8]) // (1 if self.separate else self.count))
        return out

    def start(self, node: int, ranks: int, argv: Sequence[str], devices: Sequence[str] = (), nodes: int | None = None,
              program: Sequence[str] = ("-m", "dexsim", "train")) -> subprocess.Popen:
        """Return torchrun on a node, of `nodes` (default: all) with `ranks` processes each. devices: CUDA devices of
        it."""
        nodes = self.count if nodes is None else nodes
        where = ["ip", "netns", "exec", self.names[node]] if self.separate else []
        run = ["-m", "torch.distributed.run", f"--nnodes={nodes}", f"--nproc_per_node={ranks}",
               "--rdzv_backend=c10d", f"--rdzv_endpoint={self.addresses[0]}:{PORT}", "--rdzv_id=dexsim",
               f"--rdzv_conf=last_call_timeout=1,timeout=120,is_host={int(node == 0)}",
               f"--local-addr={self.addresses[node]}", "--max-restarts=0"]  # fmt: skip
        network = "eth0" if self.separate else "lo"
        env = os.environ | {
            "NCCL_HOSTID": f"node{node}", "NCCL_NET": "Socket", "NCCL_IB_DISABLE": "1", "NCCL_MNNVL_ENABLE": "0",
            "NCCL_NVLS_ENABLE": "0", "NCCL_SOCKET_IFNAME": network, "GLOO_SOCKET_IFNAME": network,
            "OMP_NUM_THREADS": "1",
        } | ({"CUDA_VISIBLE_DEVICES": ",".join(devices)} if devices else {}) | self.env  # fmt: skip
        log = open(self.folder / f"node{node}.log", "a", encoding="utf-8")
        with log:
            return subprocess.Popen([*where, sys.executable, *run, *program, *argv], cwd=self.folder / f"node{node}",
                                    env=env, stdout=log, stderr=log, start_new_session=True)  # fmt: skip


def progress(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run so far."""
    try:
        with open(folder / "progress.csv", newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except OSError:
        return []


def measure(nodes: Nodes, each: int, settings: Sequence[str], devices: Sequence[str], end: float) -> dict[str, object]:
    """Return one training on all nodes with `each` ranks: medians over the iterations after the first FIRST of seconds
    and steps a second, and the bytes that each node sent in one of these."""
    run, began, first = nodes.folder / "node0" / "run", time.perf_counter(), (0, nodes.sent())
    started = [
        nodes.start(k, each, settings, devices[k * each: (k + 1) * each]) for k in range(nodes.count)
    ]
    while {None} <= {p.poll() for p in started} <= {None, 0} and time.perf_counter() < end:
        time.sleep(0.2)
        if not first[0] and (done := len(progress(run))) >= FIRST:
            first = done, nodes.sent()
    for process in started:
        process.terminate()  # torchrun passes it on to its ranks
    for process in started:
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
    sent, rows = nodes.sent(), progress(run)
    found: dict[str, object] = {
        "nodes": nodes.count, "ranks": nodes.count * each, "gbit": nodes.gbit, "namespaces": nodes.separate,
        "status": [p.returncode for p in started], "seconds": round(time.perf_counter() - began, 1),
        "iterations": len(rows),
    }  # fmt: skip
    if len(rows) <= first[0] or not first[0]:
        tail = (nodes.folder / "node0.log").read_text("utf-8", "replace")[-1500:]
        return found | {"error": f"only {len(rows)} iterations; {tail}"}
    for key in ("collect_s", "learn_s", "rate"):
        found[key] = float(np.median([float(r[key]) for r in rows[first[0]:]]))
    found["steps"] = round(float(rows[-1]["steps"]) / len(rows))
    found["bytes_sent"] = [round((b - a) / (len(rows) - first[0])) for a, b in zip(first[1], sent)]
    return found


def computed(one: dict, free: dict, gbit: float) -> dict[str, object]:
    """Return seconds of an iteration and steps a second over a cable of so many Gbit/s: (at most, at least) as long as
    one node's iteration, or that of nodes with a free cable, and the bytes' own time after it."""
    wire = 8 * max(free["bytes_sent"]) / (1e9 * gbit)
    seconds = [row["collect_s"] + row["learn_s"] + wire for row in (one, free)]
    return {"computed_gbit": gbit, "wire_s": wire, "seconds": seconds, "rate": [free["steps"] / s for s in seconds]}


def main(argv: list[str]) -> int:
    """Run all, print and write out/machines.json."""
    rest: list[str] = []
    own = options(argv, DEFAULTS, rest)
    ranks, count = own["gpus"], own["nodes"]
    if ranks % count:
        raise UserError(f"gpus={ranks}: must be a multiple of nodes={count}")
    devices = [] if "device=cpu" in rest else [str(k) for k in range(ranks)]
    settings = ["task=grasp", f"iterations={own['iterations']}", "final_episodes=0", "out=run", *rest]
    out, end = Path(own["out"]).resolve(), time.perf_counter() + own["seconds"]
    rates = [None if text == "" else float(text) for text in own["gbit"].split(",")]
    rows = []
    env = {"PYTHONPATH": os.pathsep.join(str(Path(p).resolve()) for p in sys.path if p or p == "")}
    for gbit in (None, *rates):
        single = not rows
        folder = out / ("one" if single else f"{count}_nodes_{gbit or 'free'}")
        shutil.rmtree(folder, ignore_errors=True)  # of an earlier time
        with Nodes(1 if single else count, folder, gbit, env) as nodes:
            rows.append(measure(nodes, ranks if single else ranks // count, settings, devices, end))
        print(json.dumps(rows[-1]), flush=True)
        out.mkdir(parents=True, exist_ok=True)
        (out / "machines.json").write_text(json.dumps(rows, indent=1), "utf-8")
        if end - time.perf_counter() < 20:
            break
    if len(rows) > 1 and rows[1]["gbit"] is None and not {"error"} & {*rows[0], *rows[1]}:
        rows += [computed(rows[0], rows[1], gbit) for gbit in CABLES]
        print("\n".join(map(json.dumps, rows[-len(CABLES):])), flush=True)
        (out / "machines.json").write_text(json.dumps(rows, indent=1), "utf-8")
    return 0 if all("error" not in r for r in rows) else 1


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
