"""Distillation: a student that learns to act as a trained teacher does, which sees more (rsl-rl's `Distillation`).

    dexsim train task=rotate agent.obs_groups.actor=[critic] out=out/teacher
    dexsim train task=rotate agent=distill agent.teacher.checkpoint=out/teacher/policy.pt task.perception=proprioception
"""

from __future__ import annotations

from typing import Any

from dexsim.errors import UserError
from dexsim.learning import checkpoint


def parts(agent: dict[str, Any]) -> tuple[str, str]:
    """Names of what acts and of what helps it to learn, in the settings of an agent."""
    return ("student", "teacher") if "student" in agent else ("actor", "critic")


def groups(agent: dict[str, Any]) -> list[str]:
    """Groups of observations that the policy of an agent acts by."""
    return list(agent["obs_groups"][parts(agent)[0]])


def fill(cfg: dict[str, Any]) -> dict[str, Any] | None:
    """Put the teacher's network and what it sees into the settings of an agent that has one; returns its checkpoint,
    None where there is none to be read: a resumed run holds its teacher. Raises UserError."""
    agent = cfg["agent"]
    taught = agent.get("teacher")
    if taught is None or "class_name" in taught:
        return None
    path = taught.get("checkpoint")
    if not path:
        raise UserError(
            "agent.teacher.checkpoint=null: name the policy.pt of a teacher, trained with"
            " agent.obs_groups.actor=[critic]"
        )
    data = checkpoint.load(path)
    own = data["config"]["agent"]
    taught |= own[parts(own)[0]]
    agent["obs_groups"]["teacher"] = groups(own)
    return data | {"path": path}


def give(algorithm: Any, data: dict[str, Any]) -> None:
    """Load a teacher's weights. Raises UserError where its observations are others."""
    try:
        algorithm.load({"actor_state_dict": data["actor"]}, {"teacher": True}, True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:160]
        raise UserError(
            f"agent.teacher.checkpoint={data['path']}: sees other observations than this task gives ({reason}); train"
            " both with the same task and task.critic"
        ) from None
