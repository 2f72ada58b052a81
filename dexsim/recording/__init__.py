"""Recordings of simulated and real hands: one MCAP format, its writer, its reader and its audit."""

from dexsim.recording.reader import read
from dexsim.recording.schema import Finding, Recording, Series, States
from dexsim.recording.writer import Writer, write

__all__ = ["Finding", "Recording", "Series", "States", "Writer", "read", "write"]
