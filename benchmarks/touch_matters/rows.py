"""What is compared: sets of sensors as settings of `task=rotate_fingertips`, and the worlds they are judged in."""

from __future__ import annotations

from dataclasses import dataclass

O = "task.observe"  # noqa: E741


@dataclass(frozen=True)
class Row:
    """key: folder name; label: what the actor has; settings: of train.py; sensors: taxels in all, None where the
    comparison is not about how much touch there is."""

    key: str
    label: str
    settings: tuple[str, ...] = ()
    sensors: int | None = None

    @property
    def touch(self) -> str:
        """How much touch it has, in a word or two; of rows with `sensors`."""
        return {"bits": "5 bits", "no_touch": "none", "springs": "600,\nsprings"}.get(self.key, f"{self.sensors}")


FULL = Row("full", "everything", sensors=600)
PAPER = (  # the five rows that carry the paper's claim
    FULL,
    Row("plain_centre", "contact centre not weighted by force", (f"{O}.force_weighted=false",)),
    Row("no_force", "no contact force", (f"{O}.contact_force=false",)),
    Row("no_touch", "no touch at all", (f"{O}.contact_force=false", f"{O}.contact_centre=false"), sensors=0),
    Row("no_pose", "no pose of the object", (f"{O}.orientation=none",)),
)
TAXELS = (  # which taxels are enough
    Row("taxels_120", "120 taxels, 24 a finger", (f"{O}.taxels=24",), 120),
    Row("taxels_25", "25 taxels, 5 a finger", (f"{O}.taxels=5",), 25),
    Row("taxels_5", "5 taxels, one a finger", (f"{O}.taxels=1",), 5),
    Row("bits", "5 contact bits", (f"{O}.taxels=bits", f"{O}.contact_centre=false"), 5),
    Row("springs", "taxels as linear springs (tactile.sum=spring)", ("tactile.sum=spring", "tactile.law=linear"), 600),
)
EVERY = (*PAPER, *TAXELS)
CLAIMS = tuple((FULL.key, row.key) for row in PAPER[1:])
"""The paper's orderings: the first row makes more successes in a row than the second."""

WORLDS = {
    "training": (),
    "wide": ("randomize.object.friction=[0.2,1.5]", "randomize.object.mass={log:[0.02,0.4]}"),
    "bench": ("reality=bench",),
}
"""Worlds to be judged in, as settings of play.py."""
ON_CPU = ("bench",)
