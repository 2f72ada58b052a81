"""Faults of a recording's signals, found before any physics is."""

from __future__ import annotations

from dexsim.recording.schema import Finding, Recording


def audit(recording: Recording) -> list[Finding]:
    """Findings about the signals themselves."""
    return []
