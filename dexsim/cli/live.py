"""play.py with view=true: which policies the page offers, and the line that says where it is."""

from __future__ import annotations

import threading
import time
import webbrowser
from pathlib import Path
from typing import Any

from dexsim import system
from dexsim.cli.start import Start
from dexsim.learning import checkpoint
from dexsim.learning.ppo import Policy, load_policy, plain_policy

PLAIN = ("scripted", "zero", "random")  # policies that need no checkpoint


def run(start: Start, env: Any, policy: Policy) -> int:
    """Serve until Ctrl-C; returns the exit status. Raises UserError."""
    from dexsim.view.live import PROGRESS, LiveView, Run

    play = start.play
    source = None if start.source is None else Path(start.source)
    files = {} if source is None else {p.name: p for p in beside(source)}
    run = Run(source, files) if source is not None and (source.parent / PROGRESS).is_file() else None

    def load(name: str) -> Policy:
        if name in files:
            data = checkpoint.load(files[name], str(env.device))
            checkpoint.check_layout(data, checkpoint.layout_of(env), str(files[name]))
            return load_policy(data, env, str(files[name]), start.typed, float(start.play["noise"]))
        return plain_policy(name, env, start.cfg["seed"])

    choices = [*files, *(n for n in PLAIN if n != "scripted" or hasattr(env, "scripted_policy"))]
    name = source.name if source is not None else str(play["policy"])
    host, port = str(play["view_host"]), int(play["view_port"])
    view = LiveView(env, policy, name, choices, load, host, port, run)
    if play["view_while"] is not None:
        threading.Thread(target=_end_with, args=(int(play["view_while"]), view), daemon=True).start()
    name = "localhost" if host in ("127.0.0.1", "0.0.0.0") else f"[{host}]" if ":" in host else host
    query = f"/?token={view.token}" if view.token else ""
    print(f"view     http://{name}:{view.port}{query}   (Ctrl-C ends)", flush=True)
    if host == "127.0.0.1":
        print(
            f"         from another machine: ssh -L {view.port}:localhost:{view.port} THIS_MACHINE,"
            " then the same address there",
            flush=True,
        )
    if play["view_open"]:
        webbrowser.open(f"http://{name}:{view.port}{query}")
    try:
        view.run(play["view_seconds"])
    except KeyboardInterrupt:
        print()
    finally:
        view.stop()
    return 0


def _end_with(process: int, view: Any) -> None:
    """Stop the view once its parent is another process than this."""
    while system.parent() == process:
        time.sleep(0.5)
    view.stop()


def beside(source: Path) -> list[Path]:
    """Return the checkpoint and those in its folder, the newest first."""
    found = sorted(source.parent.glob("*.pt"), key=lambda p: -p.stat().st_mtime)
    return [source, *(p for p in found if p.name != source.name)]
