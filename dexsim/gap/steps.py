"""The steps that every part of a machine is taken through, its drives (`gap.drives`) and its touch
(`gap.touch.diagnosis`) alike."""

from __future__ import annotations

from abc import ABC, abstractmethod

from dexsim.gap.result import Diagnosis


class NothingToJudge(Exception):
    """A part of which nothing can be said, and why."""


class Steps(ABC):
    """One part of a machine under diagnosis. Each step keeps what it found out for the next ones; any may raise
    NothingToJudge."""

    @abstractmethod
    def read(self) -> None:
        """What of the recordings tells of this part alone, as arrays."""

    @abstractmethod
    def model(self) -> None:
        """The plant that simulates it along the recordings, what is kept out of the fit, and the noise."""

    @abstractmethod
    def search(self) -> None:
        """Which effects it has: scan, fit, select on conditions left out."""

    @abstractmethod
    def locate(self) -> None:
        """Where and in which regime the believed simulator, its uncertain figures refitted, parts from the
        recordings."""

    @abstractmethod
    def judge(self) -> None:
        """Findings, confidences and errors on what was kept out of the fit."""

    @abstractmethod
    def report(self, d: Diagnosis) -> None:
        """Adds the answer to a diagnosis: findings, verdict, sentence, what is handed on to training."""

    def run(self) -> None:
        """All steps up to the judgement, in order."""
        for step in (self.read, self.model, self.search, self.locate, self.judge):
            step()
