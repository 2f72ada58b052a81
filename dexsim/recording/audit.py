"""Faults of a recording's signals, found before any physics is: `dexsim audit FILE`.

A finding names topic, time and count; nothing is repaired. Kinds and severities: `KINDS`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexsim.recording import audit_time, audit_values, reach
from dexsim.recording.schema import COMMANDS, SEVERITIES, STATES, Finding, Recording

KINDS: dict[str, str] = {
    "damage": "bytes, chunks or channels of the file that are lost",
    "unreadable": "messages or channels that cannot be decoded",
    "malformed": "messages with an unexpected number of values", "missing_topic": "a topic that most uses need",
    "missing_metadata": "a key that nothing states, and what is assumed",
    "metadata_override": "a key whose recorded value is not the one used",
    "metadata_unknown": "a key that this format does not have", "topic": "a topic found under another name",
    "joint_names": "joints found under other names, left out, or not named in the messages",
    "joint_order": "commands of one joint that another follows",
    "trajectory": "commands that came as trajectories, and when each point holds",
    "unit": "numbers that cannot be of the stated unit, or were converted",
    "time_not_monotonic": "times that go backwards", "time_repeated": "samples with the host time of the one before",
    "gap": "more than 3.5 periods without a sample", "dropped": "single samples missing",
    "burst": "samples read from a buffer, not when measured", "clock_skew": "clocks that disagree or drift",
    "held": "samples that repeat the one before while the joint moves",
    "stuck": "a channel that never changes where it must", "spike": "single samples far from both neighbours",
    "wrap": "a signed number read as unsigned, or an angle that starts again",
    "saturation": "values that pile up at their largest", "lost_sign": "an effort without its sign",
    "sign_mismatch": "an effort of the opposite sign to the stated one", "nan": "values that are not finite",
    "absent": "a joint without any value",
}  # fmt: skip
"""Every kind of finding, of the reader's and the audit's."""


def audit(recording: Recording) -> list[Finding]:
    """Return findings about the signals of a recording, in order of topic and time; [] for a clean one."""
    r = recording
    series = [s for s in r.series().values() if s.topic not in (COMMANDS, STATES)]
    found: list[Finding] = []
    with np.errstate(all="ignore"):
        for s in series:
            found += audit_time.timing(s)
        found += audit_time.stamps([r.commands, r.states.position, *series])
        found += audit_values.order(r)
        for part in r.parts():
            for s in (part.commands, part.states.position):
                found += audit_time.timing(s)
            found += audit_time.between_topics(part)
            found += _of_joints(part)
    found = list({str(f): f for f in found}.values())  # what is not of a joint, each part finds
    return sorted(found, key=lambda f: (f.topic, f.time if np.isfinite(f.time) else -1.0))


def _of_joints(r: Recording) -> list[Finding]:
    """Return findings about values; each message tells of every joint."""
    found: list[Finding] = []
    for check in (
        audit_values.commanded, audit_values.finite, audit_values.wraps, audit_values.spikes, audit_values.held,
        audit_values.stuck, audit_values.saturation, audit_values.signs, audit_values.units,
    ):  # fmt: skip
        found += check(r)
    faulty = {(f.topic, f.joint) for f in found if f.kind in ("unit", "wrap") and f.severity == "error"}
    return [*found, *reach.unreachable(r, faulty)]


def table(findings: Sequence[Finding]) -> str:
    """Return the findings as text, the worst first."""
    if not findings:
        return "no findings"
    rows = [("severity", "kind", "topic", "from s", "to s", "count", "what")]
    for f in sorted(findings, key=lambda f: -SEVERITIES.index(f.severity)):
        begin, end = ("" if not np.isfinite(x) else f"{x:.3f}" for x in (f.time, f.end))
        rows.append((f.severity, f.kind, f.topic, begin, end, str(f.count), f.text))
    width = [max(len(r[i]) for r in rows) for i in range(6)]
    return "\n".join("  ".join([*(r[i].ljust(width[i]) for i in range(6)), r[6]]) for r in rows)


def summary(r: Recording) -> str:
    """Return one line a topic: samples, rate, span."""
    lines = [
        f"{r.path}: {r.meta['source']}, {r.meta['robot']}, {len(r.joints)} joints, {r.duration:.2f} s,"
        f" effort {r.effort_is}"
    ]
    called = {"command": "commands", "position": "states", "velocity": "  velocity", "effort": "  effort"}
    for name, s in r.series().items():
        rate = (len(s) - 1) / (s.t[-1] - s.t[0]) if len(s) > 1 and s.t[-1] > s.t[0] else float("nan")
        span = f"{s.t[0]:8.3f} .. {s.t[-1]:.3f} s"
        lines.append(f"  {called.get(name, name):<15} {len(s):>7} samples  {rate:7.1f} Hz  {span}")
    return "\n".join(lines)
