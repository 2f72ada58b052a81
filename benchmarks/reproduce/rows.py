"""The rows of the paper's ablation tables: what it printed, and the settings of train.py that stand for them."""

from __future__ import annotations

from dataclasses import dataclass, field

SPIN = "task.rewards.spin=0.01"
"""A term beyond the paper's reward that every row of the rotation but `paper_reward` was trained with: it was the
default when the tables were made, and what has been trained goes on with the settings that it began with. A setting
given to `benchmarks.reproduce` comes after a row's, so a new table with the paper's reward alone is
`task.rewards.spin=0 out=ELSEWHERE`."""


@dataclass(frozen=True)
class Row:
    """key: folder name; label: what is observed or rewarded; settings: of train.py; paper: its printed numbers ({} for
    a row of our own); listed: its ten trials."""

    key: str
    label: str
    settings: tuple[str, ...]
    paper: dict[str, float] = field(default_factory=dict, hash=False)
    listed: tuple[int, ...] = ()


def _numbers(average: float, median: float, seconds: float, fall: float) -> dict[str, float]:
    return {"average": average, "median": median, "seconds_per_success": seconds, "seconds_to_fall": fall}


ROTATION = (  # table "Ablation analysis of multiple observation combinations in the real world"
    Row("full", "everything, 6D orientation", (SPIN,), _numbers(25.1, 22.0, 3.36, 84.3),
        (8, 10, 12, 15, 19, 25, 26, 35, 46, 55)),
    Row("quaternion", "quaternion instead of 6D", ("task.observe.orientation=quaternion", SPIN),
        _numbers(2.9, 2.5, 5.24, 15.2),
        (1, 1, 1, 1, 2, 3, 4, 5, 5, 6)),
    Row("plain_centre", "contact centre not weighted by force", ("task.observe.force_weighted=false", SPIN),
        _numbers(12.2, 12.0, 3.75, 45.7),
        (3, 6, 8, 10, 11, 13, 13, 15, 21, 22)),
    Row("no_force", "no contact force", ("task.observe.contact_force=false", SPIN), _numbers(13.2, 13.5, 3.19, 42.1),
        (2, 6, 10, 11, 13, 14, 16, 18, 21, 21)),
    Row("neither", "neither force nor weighting",
        ("task.observe.contact_force=false", "task.observe.force_weighted=false", SPIN),
        _numbers(7.5, 7.5, 4.03, 30.2), (1, 3, 6, 6, 7, 8, 9, 11, 11, 13)),
    Row("no_touch", "no touch at all", ("task.observe.contact_force=false", "task.observe.contact_centre=false", SPIN),
        _numbers(1.1, 1.0, 2.82, 3.10), (1, 1, 1, 1, 1, 1, 1, 1, 1, 2)),
    Row("no_orientation", "no orientation", ("task.observe.orientation=none", SPIN), _numbers(11.2, 11.5, 2.59, 29.0),
        (2, 4, 5, 8, 11, 12, 13, 16, 17, 24)),
)
UNRANDOMIZED = Row("fixed", "everything, trained without randomization", ("randomize=rotate_fixed", SPIN))
OURS = (
    UNRANDOMIZED,  # what the other world costs a policy that met no randomization
    Row("paper_critic", "everything, the paper's critic of 149", ("task.critic=paper", SPIN)),
    Row("paper_reward", "everything, without the term `spin`", ("task.rewards.spin=0",)),
    Row("curriculum", "everything, randomization widened over 2,000 control steps",
        ("task.curriculum.steps=2000", SPIN)),
)
"""Rows of our own, each the paper's first row but for one setting: what the table leaves open about this
reproduction."""

ROTATION_CLAIMS = (  # (row, row, quantity, what the paper says: first over or under second)
    *(("full", other, "average", "over") for other in ("quaternion", "plain_centre", "no_force", "neither", "no_touch",
                                                       "no_orientation")),
    ("plain_centre", "neither", "average", "over"), ("no_force", "neither", "average", "over"),
    ("neither", "no_touch", "average", "over"),
    ("no_orientation", "quaternion", "average", "over"), ("no_orientation", "full", "seconds_per_success", "under"),
)  # fmt: skip

GRASP = (  # table "Ablation on the rewards R_Force and R_torque"
    Row("both", "R_force + R_torque", (),
        {"force_low": 44.50, "force_high": 93.92, "torque_low": 1.09, "torque_high": 1.52}),
    Row("force", "R_force only", ("task.rewards.torque=0",),
        {"force_low": 37.29, "force_high": 70.02, "torque_low": 0.69, "torque_high": 0.75}),
    Row("torque", "R_torque only", ("task.rewards.force=0", "task.rewards.force_near=0", "task.rewards.worst=0"),
        {"force_low": 38.45, "force_high": 47.12, "torque_low": 0.85, "torque_high": 1.02}),
)
TORQUE_NEAR = Row("torque_near", "R_torque only, with dense companions as R_force has them",
    (*GRASP[2].settings, "task.rewards.torque_near=1.0", "task.rewards.torque_worst=1.0"))  # fmt: skip
"""A row of our own beside the grasp's: "R_force only" keeps two dense companions of it that are ours, "R_torque only"
has none."""
TABLES = {"rotation": ROTATION, "grasp": GRASP}
TASK = {"rotation": "rotate", "grasp": "grasp"}
