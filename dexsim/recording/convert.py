"""`dexsim convert IN out=OUT.mcap`: any recording that is read (CSV, NPZ, MCAP, a bag folder) as one of ours."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from dexsim.errors import UserError

HELP = """usage: dexsim convert IN out=OUT.mcap [remap.OURS=THEIRS ...] [meta.KEY=VALUE ...]

Writes a recording as MCAP in dexsim's own topics and in SI units. IN: a CSV, TSV or NPZ file with named columns
(time, command.JOINT, position.JOINT, effort.JOINT ...), an MCAP file or a bag folder. What was assumed is printed.
"""


def convert(source: Path, out: Path, remap: dict[str, str], meta: dict[str, str]) -> list[str]:
    """Writes `out`, which must not exist; returns what was assumed or lost, in words. Raises UserError."""
    from dexsim.recording.reader import read
    from dexsim.recording.writer import write

    if out.suffix != ".mcap":
        raise UserError(f"out={out}: must end in .mcap")
    if out.exists():
        raise UserError(f"out={out}: exists; choose another name, or remove it")
    if not out.parent.is_dir():
        raise UserError(f"out={out}: there is no folder {out.parent}")
    recording = read(source, remap, meta)
    write(out, recording)
    return [f"{f.severity}: {f.text}" for f in recording.findings]


def main(argv: Sequence[str]) -> int:
    """Returns the exit status. Raises UserError."""
    from dexsim.recording.arguments import read_arguments

    if not argv or argv[0] in ("-h", "--help"):
        print(HELP, end="")
        return 0 if argv else 2
    out = [a.partition("=")[2] for a in argv if a.startswith("out=")]
    if len(out) != 1 or not out[0]:
        raise UserError("say where to: out=FILE.mcap")
    paths, remap, meta = read_arguments([a for a in argv if not a.startswith("out=")])
    if len(paths) != 1:
        raise UserError(f"one recording at a time, not {len(paths)}: {', '.join(paths)}")
    for line in convert(Path(paths[0]).expanduser(), Path(out[0]).expanduser(), remap, meta):
        print(line)
    print(out[0])
    return 0


if __name__ == "__main__":
    from dexsim.console.ending import guard

    sys.exit(guard(main, sys.argv[1:]))
