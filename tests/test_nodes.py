"""One training over two machines: nodes that are network namespaces with folders of their own (benchmarks.machines)."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest
import rank_main
import shell

from benchmarks.machines import Nodes, sh
from dexsim.learning import checkpoint
from dexsim.learning.ranks import Ranks

MAIN = rank_main.__file__
QUICK = ("task=dummy", "device=cpu", "worlds=4", "final_episodes=0", "save_interval=1")


def split() -> bool:
    """Return whether network namespaces can be made here."""
    try:
        made = sh("ip", "netns", "add", "dexsim_probe", check=False).returncode == 0
        sh("ip", "netns", "del", "dexsim_probe", check=False)
    except OSError:
        return False
    return made


pytestmark = [pytest.mark.slow, pytest.mark.skipif(not split(), reason="no network namespaces here (root, iproute2)")]


@pytest.fixture(scope="module")
def configs(tmp_path_factory):
    return shell.configs(tmp_path_factory.mktemp("nodes"))


@pytest.fixture
def nodes(tmp_path):
    env = {"REPORT": "report", "PYTHONPATH": f"{shell.ROOT}:{Path(MAIN).parent}"}
    with Nodes(2, tmp_path, env=env) as two:
        yield two


def begin(nodes: Nodes, configs: Path, mode: str, *settings: str, count: int = 2):
    """Start torchrun on the first `count` nodes, one rank each."""
    argv = [MAIN, str(configs), mode, *QUICK, *settings]
    return [nodes.start(k, 1, argv, nodes=count, program=()) for k in range(count)]


def end(started, seconds: float = 120) -> list[int]:
    """Return their exit statuses."""
    limit = time.monotonic() + seconds
    try:
        return [p.wait(max(limit - time.monotonic(), 0.1)) for p in started]
    finally:
        for p in started:
            if p.poll() is None:
                p.terminate()
                p.wait(30)


def said(nodes: Nodes, k: int) -> str:
    return (nodes.folder / f"node{k}.log").read_text("utf-8", "replace")


def wait_for(path: Path, nodes: Nodes, seconds: float = 90) -> None:
    limit = time.monotonic() + seconds
    while not path.exists():
        assert time.monotonic() < limit, said(nodes, 0) + said(nodes, 1)
        time.sleep(0.1)


def test_a_run_over_two_nodes_its_loss_and_what_goes_on(nodes, configs):
    one, other = nodes.folder / "node0", nodes.folder / "node1"
    # a rank of the other node is killed: both nodes end, one line says how to go on, what was saved is whole
    started = begin(nodes, configs, "slow", "iterations=100000", "out=run")
    wait_for(one / "run" / "model_2.pt", nodes)
    assert nodes.sent()[0] > 10_000 and nodes.sent()[1] > 10_000  # gradients went over the cable
    os.kill(int((other / "report" / "1.pid").read_text()), signal.SIGKILL)
    assert all(end(started, 60))
    lines = [x for x in said(nodes, 0).splitlines() + said(nodes, 1).splitlines() if x.startswith("error:")]
    assert len(lines) == 1 and "rank 1 is gone" in lines[0] and "--nnodes=2" in lines[0], lines
    assert "resume=run/last.pt" in lines[0] and not (other / "run").exists()
    saved = checkpoint.load(one / "run" / "last.pt")["iteration"]
    # the node is back, without the checkpoint, or with another one under its name: it gets rank 0's
    (other / "run").mkdir()
    (other / "run" / "last.pt").write_bytes((one / "run" / "model_1.pt").read_bytes())
    more = ("resume=run/last.pt", f"iterations={saved + 2}", "out=again")
    assert end(begin(nodes, configs, "report", *more)) == [0, 0], said(nodes, 0) + said(nodes, 1)
    a, b = (json.loads((nodes.folder / f"node{k}" / "report" / f"{k}.json").read_text()) for k in (0, 1))
    assert a["from"] == b["from"] == saved and a["after"] == b["after"] and a["x"] != b["x"]
    assert not (other / "again").exists() and not list(Path("/tmp").glob("dexsim_*/last.pt"))
    # and on one node alone
    last = one / "again" / "last.pt"
    alone = (f"resume={last}", f"iterations={saved + 3}", f"out={nodes.folder / 'alone'}")
    assert shell.call("train", configs, *QUICK[1:], *alone) == 0
    assert checkpoint.load(nodes.folder / "alone" / "last.pt")["iteration"] == saved + 3


def test_a_checkpoint_that_the_first_node_lacks_is_one_line(nodes, configs):
    assert all(end(begin(nodes, configs, "plain", "resume=none.pt", "iterations=9")))
    assert "error: none.pt: no such checkpoint" in said(nodes, 0)
    assert "Traceback" not in "".join(x for x in said(nodes, 1).split("error:")[:1])


def test_a_pulled_cable_ends_both(nodes, configs):
    """No packet says so: the connection's keepalive finds it, within half a minute, and the ranks of both nodes end.
    (torchrun itself, on the node that is cut off, waits for minutes until it gives up.)"""
    started = begin(nodes, configs, "slow", "iterations=100000", "out=run")
    wait_for(nodes.folder / "node0" / "run" / "model_2.pt", nodes)
    nodes.cut(1)
    began = time.monotonic()
    try:
        while not all("is gone" in said(nodes, k) for k in (0, 1)):  # their last words
            assert time.monotonic() - began < 60, said(nodes, 0) + said(nodes, 1)
            time.sleep(0.2)
        assert started[0].wait(30)
    finally:
        for process in started:
            process.kill()
            process.wait()
    assert "rank 1 is gone" in said(nodes, 0) and "rank 0 is gone" in said(nodes, 1)
    assert checkpoint.load(nodes.folder / "node0" / "run" / "last.pt")["iteration"] >= 2


def test_a_rank_without_torchruns_other_machines_reads_its_own_file(tmp_path):
    with Ranks({}).leaders(str(tmp_path / "x")) as path:
        assert path == str(tmp_path / "x")
