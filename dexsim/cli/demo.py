"""`dexsim demo`: a hidden effect found, and a trained policy to watch, within a minute of installing."""

from __future__ import annotations

import contextlib
import socket
import webbrowser
from pathlib import Path

from dexsim import typed
from dexsim.errors import UserError

HELP = """usage: dexsim demo [key=value ...]

See both halves of dexsim work, on any machine: hide an effect in a simulated joint and find it (out/demo/report.html),
then play a trained grasp in the browser, to push, drop and press, until Ctrl-C.

settings (key=default):
  policy=grasp      which of the included policies: {policies}
  out=out/demo      folder of the diagnosis
  port=             where the browser finds the hand (default: 8080, or another where that is taken)
  browser=true      open both pages; false: only say where they are
  seconds=          end by itself after this many
"""
KEYS = typed.defaults(HELP)


def main(argv: list[str]) -> int:
    """Diagnose the demo, then serve a policy; returns the exit status. Raises UserError."""
    from dexsim.learning import policies

    if {"-h", "--help"} & set(argv):
        print(HELP.format(policies=", ".join(policies.included())), end="")
        return 0
    given = KEYS | typed.settings(argv, KEYS)
    typed.one_of("policy", given["policy"], policies.included())
    typed.truth("browser", given["browser"])
    seconds = typed.whole("seconds", given["seconds"], 1, 10**6) if given["seconds"] else None
    port = typed.whole("port", given["port"], 1, 65535) if given["port"] else None
    from dexsim.cli import commands
    from dexsim.gap import command

    print("1. A diagnosis: a simulated joint hides an effect, and dexsim is asked what its recordings show.\n")
    command.main(["demo=true", f"out={given['out']}"])
    page = (Path(given["out"]).expanduser() / "report.html").resolve()
    if given["browser"] == "true":
        webbrowser.open(page.as_uri())
    print(f"\npage     {page.as_uri()}\n\n2. A policy that was trained in simulation, live.\n", flush=True)
    settings = ["view=true", "worlds=1", "device=cpu", f"view_port={port or _free()}"]
    settings += [f"view_open={given['browser']}", f"view_seconds={seconds or 'null'}"]
    return commands.play([f"checkpoint={given['policy']}", *settings])


def _free() -> int:
    """Return a port of this machine that nobody serves at: the usual one, or another."""
    for port in (8080, 0):
        with socket.socket() as probe:
            with contextlib.suppress(OSError):
                probe.bind(("127.0.0.1", port))
                return int(probe.getsockname()[1])
    raise UserError("port=: this machine has no free port")
