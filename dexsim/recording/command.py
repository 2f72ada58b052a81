"""`dexsim audit FILE`: what is in a recording and what is wrong with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dexsim.recording.arguments import read_arguments
from dexsim.recording.audit import KINDS, summary, table
from dexsim.recording.reader import read


def main(argv: Sequence[str]) -> int:
    """Print what is in a recording and what is wrong with it; status 1 where a channel cannot be used as it is."""
    if not argv or argv[0] in ("-h", "--help"):
        print(
            "usage: dexsim audit FILE [remap.OURS=THEIRS ...] [meta.KEY=VALUE ...]\n\n"
            "Say what is in a recording (MCAP, a ROS 2 bag's folder, CSV or NPZ with named columns) and what is wrong "
            "with it.\n\n"
            "example:\n  dexsim audit a.mcap remap./joint_states=/xhand/state\n\n"
            "kinds of findings:"
        )
        print("\n".join(f"  {kind:<20}{text}" for kind, text in KINDS.items()))
        return 0 if argv else 2
    paths, remap, meta = read_arguments(argv)
    worst = 0
    for path in paths:
        recording = read(Path(path), remap, meta)
        print(summary(recording) + "\n")
        print(table(recording.findings) + "\n")
        worst = max(worst, int(any(f.severity == "error" for f in recording.findings)))
    return worst
